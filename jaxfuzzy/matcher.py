"""How to match a stereo pair: the settings, which carry their own checks."""

import dataclasses

from jaxfuzzy import checks

METHODS = ("sgbm", "hh", "bm")
STEP = 16  # OpenCV searches a multiple of 16 disparities
FURTHEST_PX = 2047  # disparities are int16, 16 a pixel
# Semi-global costs are int16 as well: blocks of 13 colour pixels begin to overflow, with 15 a sixth of the answers is wrong; prices
# do so from 23,000 on (on the cones; 11,600 does no harm).
LARGEST_BLOCK, LARGEST_BLOCK_BM, HIGHEST_PRICE, CHANNELS = 11, 51, 16_383, 3


@dataclasses.dataclass(frozen=True)
class Matcher:
    """How to match. The defaults are those that answered most and erred least on ten real scenes with ground truth.

    Holes are left open: filters that fill them (opencv-contrib's WLS, say) invent surface between objects.

    Attributes:
        method: "sgbm" (semi-global, three directions), "hh" (all directions: smoother fractions, several times slower)
            or "bm" (block matching: only where there is texture).
        min_disparity: Smallest disparity to search, whole pixels; None takes it from the scene. Neither it nor the number costs
            columns at a side of the picture, as they do in bare OpenCV: images are padded.
        disparities: How many disparities to search, a multiple of 16; None takes it from the scene. What lies outside a range
            that is too small is not only missing: it is matched wrongly. A warning says so.
        block: Side of the matched block, odd, up to 11; up to 51 for "bm", which uses at least 15. Larger ones fatten edges.
        smoothness: Price of a disparity step of one pixel and of more, per channel and pixel of the block. The first holds slanted
            sides flat: at the usual 8 a ball comes out with 3.7 % too large a radius, at 5 with 2.1 %, and on twelve real scenes as
            many pixels are answered, of which 3.6 in place of 3.7 % are wrong by more than 2 px.
        uniqueness: By how many per cent the best match must beat the second, below 100.
        left_right_px: Largest difference between matching left to right and right to left, the compared block wholly within both
            images' sides; None leaves the check out.
        speckle_px: Connected patches of at most so many pixels are removed; 0 keeps them.
        edge_px: Pixels to erode from the nearer side of a depth edge, where matching bleeds over; 0 keeps them.
        refine: Refine the matcher's sixteenths of a pixel by the images' gradients, without which clouds come in layers;
            on twelve real scenes the deviation from the truth fell by a sixth to a half, from 0.29 to 0.20 px on average. Where
            noise or compression leaves them rough, images are smoothed, matched once more and refined further: with noise of 4
            grey levels a twentieth more is answered, and the deviation falls from 0.41 to 0.29 px.
        disparity_std_px: Standard deviation of a disparity, from which every point's `depth_std` comes. None takes the mean of
            0.13 to 0.32 px measured on these scenes, of 370 to 560 rows, and in proportion to the rows for larger images, whose
            blur has as many pixels more: at 1,500 rows 0.6 px were measured.
    """

    method: str = "sgbm"
    min_disparity: int | None = None
    disparities: int | None = None
    block: int = 3
    smoothness: tuple[float, float] = (5.0, 32.0)
    uniqueness: int = 10
    left_right_px: float | None = 1.0
    speckle_px: int = 100
    edge_px: int = 1
    refine: bool = True
    disparity_std_px: float | None = None

    def __post_init__(self) -> None:
        checks.choice(self.method, "method", METHODS)
        if self.min_disparity is not None:
            checks.integer(self.min_disparity, "min_disparity", at_least=-FURTHEST_PX, at_most=FURTHEST_PX)
        if self.disparities is not None:
            checks.integer(self.disparities, "disparities", at_least=STEP, at_most=2 * FURTHEST_PX)
            if self.disparities % STEP:
                raise ValueError(f"disparities must be a multiple of {STEP}, got {self.disparities}")
        largest = LARGEST_BLOCK_BM if self.method == "bm" else LARGEST_BLOCK
        checks.integer(self.block, f"block with method={self.method!r}", at_least=1, at_most=largest)
        if self.block % 2 == 0:
            raise ValueError(f"block must be odd, got {self.block}")
        if checks.real(self.smoothness, "smoothness").shape != (2,) or not 0 < self.smoothness[0] < self.smoothness[1]:
            raise ValueError(f"smoothness must be two prices, 0 < first < second, got {self.smoothness}")
        highest = HIGHEST_PRICE / (CHANNELS * self.block**2)
        if self.method != "bm" and not self.smoothness[1] <= highest:
            raise ValueError(
                f"smoothness must be at most {highest:.0f} with block={self.block}, beyond which OpenCV's costs overflow, got"
                f" {self.smoothness}"
            )
        checks.integer(self.uniqueness, "uniqueness", at_least=0, at_most=99)
        if self.left_right_px is not None:
            checks.number(self.left_right_px, "left_right_px", above=0.0)
        checks.integer(self.speckle_px, "speckle_px", at_least=0, at_most=2**31 - 1)
        checks.integer(self.edge_px, "edge_px", at_least=0, at_most=20)
        checks.flag(self.refine, "refine")
        if self.disparity_std_px is not None:
            checks.number(self.disparity_std_px, "disparity_std_px", above=0.0)


def chosen(matcher: Matcher | None) -> Matcher:
    """The matcher given, or the usual one."""
    if not isinstance(matcher, Matcher | None):
        raise TypeError(f"matcher must be a Matcher, got {matcher!r}; Matcher(method=...) says how to match")
    return Matcher() if matcher is None else matcher
