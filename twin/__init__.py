"""TSIS digital twin: from a press on tissue to the picture of an optical tactile sensor.

import twin

frame = twin.simulate(twin.load_design("tsis"), twin.Inclusion(size=10, depth=5, modulus=100))
frame.write("out")
"""

from fem import Inclusion
from twin.complaint import DesignError
from twin.design import Design, load_design
from twin.frame import Frame
from twin.simulate import simulate

__all__ = ["Design", "DesignError", "Frame", "Inclusion", "load_design", "simulate"]
