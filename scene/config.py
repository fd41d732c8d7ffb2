"""How a scene is parsed."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np

from recordings.settings import check_finite, check_within
from scene.copies import asked_copies, slot_names

BOUNDS = {
    "rounds": (0, 100),
    "pool": (1, 4096),
    "shape_samples": (0, 1024),
    "chains": (1, 1024),
    "sweeps": (1, 10_000_000),
    "most": (1, 8),
    "gamma": (0.2, 5.0),
    "colour_weight": (0.0, 1.0),
}
"""Below these is nothing to do; beyond them nobody has the memory or the time: a slip of the hand."""

Graph = Literal["infer", "fixed", "search"]

Likelihood = Literal["depth", "cloud"]

Colour = Literal["off", "add", "only"]

Proposals = Literal["points", "masks", "both"]

WORDS = {"graph": Graph, "likelihood": Likelihood, "colour": Colour, "proposals": Proposals}
"""Settings that are one of a few words."""

MOST_FRAME = 2**31
"""Beyond this number of a frame, at 30 Hz after two years: a slip of the hand, too."""

MOST_EXACT = 2
"""Objects whose joint presence is computed: poses are drawn for each set of them."""

EXACT_DRAWS = 2**15
"""Of prior poses for each set: a share of 0.05 is then known to 0.0012, and the presence to 0.005."""


@dataclass(frozen=True, kw_only=True)
class ParseConfig:
    """Settings of `voxscene parse`; metres and radians.

    Attributes:
        objects: names of the objects to look for, `mug:2` for up to two of a kind; none means all that are
            known, one of each.
        frames: numbers of the depth frames that are used; none means the first that shows enough.
        support: x, y, z of a point and of the normal of the one support, in the first camera's frame; none
            means all planes that are found.
        region: least and greatest x, y, z of what is looked at, in the same frame; none means all.
        graph: `infer` samples scene graphs, `fixed` keeps every object floating, which costs nothing then
            (the ablation 3DP3*); `search` lets things rest in the search alone.
        likelihood: what chains compare: `depth` images pixel by pixel, or the paper's point clouds (`cloud`).
        colour: `off` reads depth alone, `only` colour alone (`scene.colour_parsing`); `add` compares both.
        colour_weight: of `add`: exponent of the colours' factor; 0 leaves it out.
        table: of `only`: height of the camera over the table in metres, its pitch downwards and its roll in
            degrees; none takes the recorded pose over the plane z = 0 or the depth.
        most: of `only`: things at most on the table; copies of one kind count.
        light: of `only`: direction of the lamp from the table, x, y, z, and share of ambient light; none
            means the most probable of a fixed set.
        gamma: of `only` and `add`: exponent by which stored colours become light; 2.2 of photographs, 1
            where they are stored linearly.
        presence: prior probability that an object is there. Of how many are there, 0.5 says nothing: every
            number is as probable (`scene.model.number_prior`).
        proposals: where the search's poses come from before they are refined: templates matched to observed
            `points`, convolution `masks`, or `both`, half and half.
        unknown_solids: whether boxes and cylinders of free size compete with what is asked for when presence
            is told. The program lets them where shapes are meshes: learned ones are rough by millimetres,
            and a smooth solid would win.
        exact: one object or two whose presence is computed exactly where they are not found: at rest on a
            support, or without one anywhere in the region.
        rounds: of renewed search on what is left unexplained.
        pool: poses an object and round that are compared jointly.
        shape_samples: draws of each uncertain shape that the likelihood is averaged over; 0 takes every
            shape for certain.
        chains: Markov chains.
        sweeps: of each chain, a move for every object; the first third teaches the proposals and is dropped.
        model_error_m: error of shapes and calibration, added in quadrature to the sensor's; as a whole it
            also moves and turns every object of a sample (2 mm is what YCB-Video's poses differ by).
        search_error_m: the same during the search, where poses are coarse.
        scale_error: of the camera, by which all objects of a sample are farther or nearer, over 1.
        outlier_probability: share of pixels that show what nobody models.
        cloud_radius_m: of the ball round a rendered point in which observed points lie.
        cloud_outlier_probability: share of points that show what nobody models.
        contact_sigma_m: standard deviation of the gap between faces in contact, and of how far an object's
            surface reaches below the table.
        loose_sigma_m: the same of rests whose surfaces meet elsewhere than on the faces.
        contact_concentration: kappa of the direction of contact about flush.
        slack_share: weight of rests that are not flush with a face.
        upward_concentration: kappa of the face that carries another about the one that points up; of
            effect where there is a table, as `floating_weight`.
        floating_weight: odds of an object that rests on nothing against one given supporter.
    """

    objects: tuple[str, ...] = ()
    frames: tuple[int, ...] = ()
    support: tuple[float, ...] = ()
    region: tuple[float, ...] = ()
    graph: Graph = "infer"
    likelihood: Likelihood = "depth"
    colour: Colour = "off"
    colour_weight: float = 1.0
    table: tuple[float, ...] = ()
    most: int = 3
    light: tuple[float, ...] = ()
    gamma: float = 2.2
    presence: float = 0.5
    proposals: Proposals = "both"
    unknown_solids: bool = True
    exact: tuple[str, ...] = ()
    rounds: int = 2
    pool: int = 48
    shape_samples: int = 0
    chains: int = 16
    sweeps: int = 60
    model_error_m: float = 0.002
    scale_error: float = 0.005
    search_error_m: float = 0.003
    outlier_probability: float = 0.1
    cloud_radius_m: float = 0.005
    cloud_outlier_probability: float = 0.01
    contact_sigma_m: float = 0.005
    loose_sigma_m: float = 0.02
    contact_concentration: float = 500.0
    slack_share: float = 0.1
    upward_concentration: float = 10.0
    floating_weight: float = 0.02

    def __post_init__(self) -> None:
        check_finite(self)
        for name, (low, high) in BOUNDS.items():
            check_within(self, low, high, (name,))
        for name, known in ((name, get_args(kind)) for name, kind in WORDS.items()):
            if getattr(self, name) not in known:
                raise ValueError(f"{name} must be {' or '.join(known)}, got {getattr(self, name)!r}")
        for name in ("objects", "exact"):
            if isinstance(getattr(self, name), str):
                raise ValueError(f"{name} must be several names, such as ({getattr(self, name)!r},)")
        asked = [asked_copies(entry) for entry in self.objects]
        names = [name for name, _ in asked]
        if twice := [name for name in names if names.count(name) > 1]:
            raise ValueError(f"objects names {twice[0]} twice; for two of a kind write {twice[0]}:2")
        if self.colour == "only" and any(count > 1 for _, count in asked):
            raise ValueError("objects: colour only takes up to `most` copies of every kind; name kinds alone")
        if min(self.frames, default=0) < 0 or list(self.frames) != sorted(set(self.frames)):
            raise ValueError(f"frames must be increasing numbers from 0, got {self.frames}")
        if max(self.frames, default=0) > MOST_FRAME:
            raise ValueError(f"frames must be numbers up to {MOST_FRAME}, got {max(self.frames)}")
        if self.support and (len(self.support) != 6 or not any(self.support[3:])):
            raise ValueError(f"support must be a point and a normal, x,y,z,nx,ny,nz, got {self.support}")
        if self.region and (len(self.region) != 6 or any(np.greater_equal(self.region[:3], self.region[3:]))):
            raise ValueError(f"region must be xmin,ymin,zmin,xmax,ymax,zmax, got {self.region}")
        if len(self.table) not in (0, 2, 3):
            raise ValueError(f"table must be HEIGHT,PITCH or HEIGHT,PITCH,ROLL, got {self.table}")
        if self.light and (len(self.light) != 4 or not any(self.light[:3]) or not 0 <= self.light[3] <= 1):
            raise ValueError(f"light must be a direction and a share of ambient light, got {self.light}")
        if not 0 < self.presence < 1:
            raise ValueError(f"presence must lie between 0 and 1, got {self.presence}")
        if len(set(self.exact)) != len(self.exact) or len(self.exact) > MOST_EXACT:
            sets = 2 ** len(self.exact) - 1
            raise ValueError(
                f"exact takes one object or two, got {','.join(self.exact)}: {sets} sets of them would have "
                f"to be rendered together, {EXACT_DRAWS} times each"
            )
        slots = {slot for name, count in asked for slot in slot_names([name], count)}
        if missing := set(self.exact) - (slots or set(self.exact)):
            raise ValueError(f"exact names {min(missing)!r}, which is none of the objects asked for")
        if self.exact and self.colour == "only":
            raise ValueError("exact needs depth images; it does not go with colour only")
        if self.likelihood == "cloud" and self.colour == "add":
            raise ValueError("colour add compares images; it does not go with likelihood cloud")
        scales = self.contact_sigma_m, self.loose_sigma_m, self.contact_concentration, self.search_error_m
        if min(self.model_error_m, self.scale_error) < 0:
            raise ValueError("model_error_m and scale_error must not be negative")
        if min(*scales, self.cloud_radius_m, self.floating_weight) <= 0 or self.upward_concentration < 0:
            raise ValueError("sigmas, errors, radii, concentrations and floating_weight must be positive")
        if not 0 <= self.slack_share < 1:
            raise ValueError(f"slack_share must lie in [0, 1), got {self.slack_share}")
        if not all(0 < share < 1 for share in (self.outlier_probability, self.cloud_outlier_probability)):
            raise ValueError("outlier_probability and cloud_outlier_probability must lie between 0 and 1")

    @property
    def adds_colour(self) -> bool:
        """Whether colours are compared beside depth."""
        return self.colour == "add" and self.colour_weight > 0
