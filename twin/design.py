"""A design: the sensor, the specimen and the press, as a frozen, checked value read from a TOML file.

The sections of the file compose the dataclasses of the rooms: `fem.Layer` and `Glass`, `Led`, `Camera`,
`Skin` of `scenes.sensor` stand in it as they are; `Design.probe`, `Design.slab` and `Design.sensor` hand
each room its own input. Lengths are mm, moduli kPa, wavelengths nm; the frame is that of `scenes.sensor`.
"""

from __future__ import annotations

import json
import tomllib
from collections.abc import Iterable
from dataclasses import replace
from functools import lru_cache
from importlib.resources import files
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, TypeAdapter, ValidationError
from pydantic.dataclasses import dataclass
from pydantic.json_schema import GenerateJsonSchema

import fem
from fem.model import Length, Modulus, Offset, Poisson, Sides, Tilt
from scenes import ies
from scenes.led import Light
from scenes.sensor import Camera, Glass, Guide, Housing, Led, Sensor
from scenes.skin import Absorption, Anisotropy, Colour, RefractiveIndex, Scattering, Skin, Tissue
from twin.complaint import DesignError, from_validation, not_finite, shown
from twin.conflicts import design_conflicts, inclusion_conflicts
from twin.texts import read_text
from twin.waveguide import CONFIG, Waveguide

MAX_STRAIN = 0.2
"""Deepest press, as a share of the slab's thickness, 6 mm into 30 mm: no deeper one has been compared with an
independent code."""

MIN_INDENTATION_MM = 1e-4
"""Smallest press: far below what any camera sees."""

_MAX_BYTES = 1_000_000  # of a design's file
_ONE_LINE = r"^[^\x00-\x1f\x7f-\x9f]*$"

Depth = Annotated[float, Field(ge=MIN_INDENTATION_MM, le=100.0)]
Mechanics = Literal["finite", "linear"]


@dataclass(frozen=True, config=CONFIG)
class Specimen:
    """The tissue: a slab fixed to a flat chest wall at its far face."""

    thickness_mm: Annotated[Length, Field(description="Thickness from contact surface to chest wall, mm.")]
    width_mm: Annotated[Length, Field(description="Side of the square slab, mm.")]
    modulus_kPa: Annotated[Modulus, Field(description="Young's modulus of the tissue, kPa.")]
    poisson: Annotated[Poisson, Field(description="Poisson's ratio of the tissue, up to 0.4999.")] = 0.49
    sides: Annotated[
        Sides,
        Field(description="Sides of the slab: free, or symmetric, as if the tissue went on mirrored there."),
    ] = "free"
    refractive_index: Annotated[RefractiveIndex, Field(description="Refractive index of the tissue.")] = 1.40
    scattering_per_mm: Annotated[
        Scattering, Field(description="Reduced scattering coefficient µs' = (1 - g) µs of the tissue, 1/mm.")
    ] = 1.0
    absorption_per_mm: Annotated[
        Absorption, Field(description="Absorption coefficient µa of the tissue, 1/mm.")
    ] = 0.02
    anisotropy: Annotated[
        Anisotropy,
        Field(description="Mean cosine g of one scattering; 0 is even, skin has about 0.9."),
    ] = 0.0
    inclusion: Annotated[
        Colour | None,
        Field(description="Optics of an inclusion's own, if any; only reference light sees it."),
    ] = None


@dataclass(frozen=True, config=CONFIG)
class PressDepths:
    """How the sensor is pressed where nothing else is said."""

    indentation_mm: Annotated[
        tuple[Depth, ...],
        Field(
            min_length=1,
            max_length=100,
            description="Depths that the glass moves towards the chest wall, mm.",
        ),
    ] = (2.0,)
    tilt_deg: Annotated[
        tuple[Tilt, Tilt],
        Field(description="Turn of the sensor about x, then y, through the middle of its surface, degrees."),
    ] = (0.0, 0.0)
    position_mm: Annotated[
        tuple[Offset, Offset], Field(description="Centre of the sensor minus that of the specimen, mm.")
    ] = (0.0, 0.0)


@dataclass(frozen=True, config=CONFIG)
class Signal:
    """The thresholds k above which a value is signal; fixed here, never chosen per picture."""

    displacement_um: Annotated[
        float, Field(ge=1e-3, le=1e5, description="Threshold of the surface displacement, µm.")
    ] = 2.0
    counts: Annotated[float, Field(ge=1e-3, le=65535.0, description="Threshold of the picture, counts.")] = (
        10.0
    )


@dataclass(frozen=True, config=CONFIG)
class Design:
    """A tactile sensor, a specimen and a press: everything the twin needs but the inclusion."""

    name: Annotated[
        str,
        Field(
            min_length=1,
            max_length=100,
            pattern=_ONE_LINE,
            description="Name of the design; it goes with every frame.",
        ),
    ]
    waveguide: Annotated[Waveguide, Field(description="The waveguide: size, index and elastic layers.")]
    leds: Annotated[
        tuple[Led, ...],
        Field(min_length=1, max_length=64, description="The LEDs; one picture layer for each."),
    ]
    camera: Annotated[Camera, Field(description="The camera below the glass.")]
    specimen: Annotated[Specimen, Field(description="The tissue slab, without its inclusion.")]
    description: Annotated[
        str, Field(max_length=1000, pattern=_ONE_LINE, description="One line for people.")
    ] = ""
    mechanics: Annotated[
        Mechanics,
        Field(description="finite: neo-Hookean, finite strain; linear: small strain, as the paper has it."),
    ] = "finite"
    light: Annotated[Light, Field(description="What light the LEDs give.")] = Light()
    glass: Annotated[Glass, Field(description="The rigid plate between waveguide and camera.")] = Glass()
    housing: Annotated[Housing, Field(description="The box below the glass: black, or white.")] = Housing()
    surface: Annotated[
        Skin, Field(description="The contact between waveguide and tissue: roughness, film, dust, sheet.")
    ] = Skin()
    press: Annotated[PressDepths, Field(description="The press, where nothing else is said.")] = PressDepths()
    signal: Annotated[Signal, Field(description="The thresholds k of the scalars.")] = Signal()

    def __post_init__(self) -> None:
        found = list(design_conflicts(self))
        if found:
            first, more = found[0], len(found) - 1
            raise DesignError(first.field, first.received, first.allowed, more=more, conflicts=found)

    def probe(self) -> fem.Probe:
        """Return the waveguide as the mechanics see it."""
        guide = self.waveguide
        layers = tuple(fem.Layer(one.thickness_mm, one.modulus_kPa, one.poisson) for one in guide.layers)
        return fem.Probe(width_mm=guide.width_mm, layers=layers, dome_radius_mm=guide.dome_radius_mm)

    def slab(self) -> fem.Slab:
        """Return the specimen as the mechanics see it."""
        tissue = self.specimen
        return fem.Slab(
            thickness_mm=tissue.thickness_mm,
            width_mm=tissue.width_mm,
            modulus_kPa=tissue.modulus_kPa,
            poisson=tissue.poisson,
            sides=tissue.sides,
        )

    def pose(self) -> fem.Pose:
        """Return how the probe meets the specimen."""
        return fem.Pose(tilt_deg=self.press.tilt_deg, position_mm=self.press.position_mm)

    def pressed(
        self,
        *,
        mechanics: str | None = None,
        tilt_deg: Iterable[float] | None = None,
        position_mm: Iterable[float] | None = None,
    ) -> Design:
        """Return the design with another way to press; what is None stays. Raises `DesignError`."""
        pose = {"tilt_deg": _pair(tilt_deg), "position_mm": _pair(position_mm)}
        changes = {name: value for name, value in pose.items() if value is not None}
        if not changes and mechanics is None:
            return self
        try:
            press = replace(self.press, **changes)
        except ValidationError as error:
            found = from_validation(error, changes, TypeAdapter(PressDepths).json_schema())
            raise found.renamed(f"press.{found.field}") from None
        given = {"press": press, **({} if mechanics is None else {"mechanics": mechanics})}
        try:
            return replace(self, **given)  # type: ignore[arg-type]
        except ValidationError as error:
            raise from_validation(error, given, design_schema()) from None

    def guide(self, wavelength_nm: float | None = None) -> Guide:
        """Return the waveguide as light of a wavelength sees it, by default that of `light`."""
        return self.waveguide.optics(wavelength_nm or self.light.wavelength_nm)

    def tissue(self) -> Tissue:
        """Return the specimen as light sees it."""
        slab = self.specimen
        return Tissue(slab.refractive_index, slab.scattering_per_mm, slab.absorption_per_mm, slab.anisotropy)

    def sensor(self, wavelength_nm: float | None = None) -> Sensor:
        """Return the whole sensor as light of a wavelength sees it, by default that of `light`."""
        wavelength = wavelength_nm or self.light.wavelength_nm
        return Sensor(
            guide=self.guide(wavelength),
            glass=self.glass.at(wavelength),
            leds=self.leds,
            camera=self.camera,
            skin=self.surface,
            tissue=self.tissue(),
            effective_modulus_kPa=self.effective_modulus_kPa,
            wavelength_nm=wavelength,
            inclusion=self.specimen.inclusion,
            housing=self.housing,
        )

    @property
    def effective_modulus_kPa(self) -> float:
        """Contact modulus E*, kPa: 1/E* = sum of (1 - nu²)/E over both surfaces (Johnson 1985, eq. 4.24).

        A contact sheet is what touches, so that its modulus counts in the tissue's place.
        """
        sides = (self.waveguide.layers[0], self.surface.sheet or self.specimen)
        return 1.0 / sum((1.0 - side.poisson**2) / side.modulus_kPa for side in sides)

    @property
    def max_indentation_mm(self) -> float:
        """Deepest press that is allowed, mm."""
        return MAX_STRAIN * self.specimen.thickness_mm

    def check_inclusion(self, inclusion: fem.Inclusion) -> None:
        """Raise `DesignError` if the inclusion leaves the slab, or does not lie under the probe."""
        if not isinstance(inclusion, fem.Inclusion):
            raise DesignError("inclusion", shown(inclusion), "a twin.Inclusion, or None for plain tissue")
        for conflict in inclusion_conflicts(self, inclusion):
            raise conflict

    def check_indentation(self, indentation: float, field: str = "press.indentation_mm") -> None:
        """Raise `DesignError` if the press is not a depth in mm that the model can be trusted with."""
        if not MIN_INDENTATION_MM <= indentation <= self.max_indentation_mm:
            raise DesignError(field, shown(indentation), self.depth_in_words)

    @property
    def depth_in_words(self) -> str:
        """What a press depth may be, for people."""
        return (
            f"a number >= {MIN_INDENTATION_MM:g} and <= {self.max_indentation_mm:g} mm "
            f"({MAX_STRAIN:.0%} of the specimen)"
        )


def _pair(given: Any) -> Any:
    """Any kind of sequence as a tuple; what is none goes on as it is, to be refused by name."""
    return tuple(given) if isinstance(given, Iterable) and not isinstance(given, str | bytes) else given


_ADAPTER = TypeAdapter(Design)


class _Untitled(GenerateJsonSchema):
    """Schema without titles made up from the names: editors would show "Pixel Um" before the description."""

    def field_title_should_be_set(self, schema: Any) -> bool:
        return False


def design_schema() -> dict[str, Any]:
    """Return the JSON schema (draft 2020-12) of a design file."""
    schema = _ADAPTER.json_schema(schema_generator=_Untitled)
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", **schema, "title": "TSIS twin design"}


_schema = lru_cache(maxsize=1)(design_schema)


def shipped_designs() -> list[str]:
    """Return the names of the designs that come with the package."""
    names = (entry.name for entry in files("assets").joinpath("designs").iterdir())
    return sorted(name.removesuffix(".toml") for name in names if name.endswith(".toml"))


def load_design(name_or_path: str | Path) -> Design:
    """Return the design of that name under ``assets/designs``, or of that TOML file.

    A shipped name wins over a file of the same name: write ``./tsis`` for the latter.

    Raises
    ------
    DesignError
        One line: file, dotted field, the value received and what is allowed.
    """
    source = str(name_or_path)
    text = _read(name_or_path)
    try:
        return parse_design(ies.beside(tomllib.loads(text), _place(name_or_path).parent), source)
    except tomllib.TOMLDecodeError as error:
        message, _, place = str(error).rpartition(" (at ")
        raise DesignError(
            place.rstrip(")") or "the file", f"text that is not TOML ({message})", "TOML", source=source
        ) from None
    except RecursionError:
        raise DesignError(
            "the file", "lists or tables nested too deep", "a few levels", source=source
        ) from None
    except DesignError:
        raise
    except ValueError:  # Python reads no integer of thousands of digits
        raise DesignError("the file", "a number that is too long", "numbers", source=source) from None


def parse_design(data: dict[str, Any], source: str = "") -> Design:
    """Return the design that nested tables describe; ``source`` names them in the error."""
    try:
        # As JSON, because only there does pydantic's strict mode take a table for a dataclass and a list for
        # a tuple while it still refuses "25" or true where a number belongs. JSON has no dates, and neither
        # has a design: true, which no field takes, is refused in their place.
        text = json.dumps(data, default=lambda date: True, allow_nan=False)
    except ValueError:
        first, *more = not_finite(data, _schema())
        allowed = first.allowed
        raise DesignError(first.field, first.received, allowed, source=source, more=len(more)) from None
    try:
        return _ADAPTER.validate_json(text, strict=True)
    except ValidationError as error:
        raise from_validation(error, data, _schema()).renamed(source=source) from None


def _place(name_or_path: str | Path) -> Path:
    """Return the file of a shipped design, or the path itself."""
    source = str(name_or_path)
    if source in shipped_designs():
        return Path(str(files("assets").joinpath("designs", f"{source}.toml")))
    return Path(source)


def _read(name_or_path: str | Path) -> str:
    source = str(name_or_path)
    if not source:
        raise DesignError("DESIGN", "an empty name", "a shipped design or a TOML file")
    try:
        return read_text(_place(name_or_path), _MAX_BYTES, source)
    except DesignError:
        raise
    except IsADirectoryError:
        raise DesignError("DESIGN", f"the directory {shown(source)}", "a TOML file") from None
    except (OSError, ValueError):
        names = ", ".join(shipped_designs())
        raise DesignError(
            "DESIGN", shown(source), f"a shipped design ({names}) or a TOML file that can be read"
        ) from None
