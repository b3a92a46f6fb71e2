"""What the stored energy gains where nodes move through the material while places stay: material forces.

The derivative of the energy by a node's undeformed place X, its deformed place held, is Eshelby's
energy-momentum tensor against the gradient of its shape function,

    c_a = sum over points of weight (W delta_ab - F_ka P_kb) dN / dX_b

(Eshelby 1975; [eshelby1975]; of finite elements, Braun 1997; [braun1997]). On a smooth free face its part
along the face is -F^T f, f the node's ordinary force: it vanishes where f is normal to the deformed face.
Where the face ends or bends within a cell, it says so to the energy's own order, which a slope taken from
displacements does not.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fem import elasticity
from fem.quadrature import NODES, SHAPE, Quadrature

Floats = NDArray[np.float64]


def material_forces(quad: Quadrature, place: Floats, moved: Floats, shear: Floats, bulk: Floats) -> Floats:
    """Derivative of each element's stored energy by its nodes' undeformed places, the deformed ones held.

    Parameters
    ----------
    quad
        Of m elements.
    place, moved
        Undeformed places of all nodes, and their displacements, (nodes, 3) mm.
    shear, bulk
        Moduli of each element, (m,) kPa.

    Returns
    -------
    (m, 27, 3) array, mN.

    Raises
    ------
    Inverted
        Where a volume is not positive.
    """
    found = np.empty((quad.size, NODES, 3))
    for part in elasticity.chunks(quad.size):
        at = elasticity.points(quad, moved, shear[part], bulk[part], part)
        weight = quad.weight[part]
        # the energy is p (J - 1) - p² / 2 kappa at the p for which its integral is largest: p need not change
        excess = (at.det - 1) - at.pressure / bulk[part][:, None]
        energy = at.stored + 0.5 * at.pressure * excess
        momentum = energy[..., None, None] * np.eye(3) - at.f.swapaxes(2, 3) @ at.piola
        momentum *= weight[..., None, None]
        found[part] = np.einsum("mqab,mbiq->mia", momentum, at.gradient, optimize=True)
        # the pressure's modes are linear in X, and move with the nodes
        spread = np.einsum("mia,iq->mqa", place[quad.nodes[part]], SHAPE)
        spread -= spread.mean(axis=1, keepdims=True)
        across = spread.swapaxes(1, 2)
        slope = np.linalg.solve(across @ spread, across @ at.pressure[..., None])[..., 0]
        found[part] += ((weight * excess) @ SHAPE.T)[..., None] * slope[:, None]
    return found
