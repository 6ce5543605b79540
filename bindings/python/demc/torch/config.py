"""The configuration of a network: the tables of variants and readings, and the `model` part of a bundle's metadata.

Section, equation, and figure numbers are the paper's.
"""

from __future__ import annotations

from dataclasses import dataclass

LEVEL_FACTORS = (1, 2, 4, 8, 8)
"""The paper's channels of the levels, in units of the base width (Fig. 3)."""


@dataclass(frozen=True)
class Variant:
    """A network variant: fusion sub-network or not, and the inputs of each encoder.

    The last encoder feeds the latent.
    """

    fusion: bool
    encoders: tuple[tuple[str, ...], ...]


VARIANTS = {
    "demc": Variant(fusion=True, encoders=(("detail",), ("color",))),
    "demc-nosn": Variant(fusion=False, encoders=(("features",), ("color",))),  # Sec. 4.3
    "semc": Variant(fusion=True, encoders=(("detail", "color"),)),  # Sec. 4.4, Fig. 4
    "color-only": Variant(fusion=False, encoders=(("color",),)),  # ours: a control
}
KPCN = "kpcn"
"""The networks of `kpcn.Kpcn`."""
UNETS = {"unet": None, "unet-demc": "detail", "unet-nosn": "features"}
"""The variants of `unet.Unet`, and what their second encoder takes."""


@dataclass(frozen=True)
class Reading:
    """Details in which the paper's text and the authors' published model differ."""

    convs: tuple[int, ...]  # convolutions of each encoder level
    skip_after: tuple[int, ...]  # the skip is taken after this many of them
    norm: bool  # BatchNorm in the latent and after each deconvolution
    fuse_relu: bool  # ReLU after the 1x1 skip fusion
    head_kernel: int  # side of the output convolution's kernel


READINGS = {
    "paper": Reading(convs=(3, 3, 3, 3, 3), skip_after=(2, 2, 2, 2, 2), norm=False, fuse_relu=True, head_kernel=1),
    "released": Reading(convs=(2, 2, 3, 3, 3), skip_after=(2, 2, 3, 3, 3), norm=True, fuse_relu=False, head_kernel=3),
}


@dataclass(frozen=True)
class ModelConfig:
    """The `model` part of a bundle's metadata.

    `head` "kernel" predicts kernels (`kernel_head`). "grey" and "xavier", and `detail`, are initialisations.
    """

    variant: str = "demc"
    reading: str = "paper"
    width: int = 64
    levels: tuple[int, ...] = LEVEL_FACTORS
    head: str = "grey"
    detail: str = "open"
    size: str = "base"  # of a U-Net: small, base, medium, or large
    guides: str = "albedo-normal"  # of a U-Net: none, albedo, or albedo-normal

    def __post_init__(self) -> None:
        for what, value, known in (
            ("variant", self.variant, (*VARIANTS, KPCN, *UNETS)),
            ("reading", self.reading, READINGS),
            ("head", self.head, ("grey", "xavier", "kernel")),
            ("detail", self.detail, ("open", "xavier")),
            ("size", self.size, ("small", "base", "medium", "large")),
            ("guides", self.guides, ("none", "albedo", "albedo-normal")),
        ):
            if value not in known:
                raise ValueError(f"unknown {what} {value!r}: expected one of {', '.join(known)}")
        if self.width < 1:
            raise ValueError(f"width is {self.width}: expected at least 1")
        object.__setattr__(self, "levels", tuple(self.levels))  # JSON has lists
        if len(self.levels) != len(LEVEL_FACTORS) or min(self.levels) < 1:
            raise ValueError(f"levels is {self.levels}: expected five numbers of at least 1")

    @property
    def level_channels(self) -> list[int]:
        """Channels of each level, from the full resolution down."""
        return [self.width * factor for factor in self.levels]

    def __str__(self) -> str:
        """A short name; includes the levels if they are not the paper's."""
        if self.variant == KPCN:
            return f"{self.variant}, width {self.width}"
        if self.variant in UNETS:
            return f"{self.variant}, {self.size}"
        levels = "" if self.levels == LEVEL_FACTORS else f", levels of {self.level_channels}"
        return f"{self.variant}, {self.reading} reading, width {self.width}{levels}"
