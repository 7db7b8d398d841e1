"""The stereo rig: its record, its files, and its calibration from photographs of a board.

Conventions, the ones of OpenCV: x right, y down, z forward; the right camera stands at +x. A point at depth z (metres)
is seen `disparity_px = focal_px[0] * baseline_m / z - doffs_px` further left in the right image. `doffs_px` is the
right principal point's column minus the left one's; leaving it out bends space: planes stay planes, spheres do not.
"""

import dataclasses
import json
import os
import warnings
from pathlib import Path
from typing import Any

import numpy as np

from jaxfuzzy import checks, rigfiles
from jaxfuzzy.files import one_line, read_bytes, write_atomic
from jaxfuzzy.rigwriters import SCHEMA, VERSION, written

# Calibration files have a few thousand bytes; looking through a huge text line by line would only seem to hang.
LARGEST_FILE = 1 << 20
PLAUSIBLE_BASELINE_M = (1e-3, 10.0)


@dataclasses.dataclass(frozen=True)
class Rig:
    """Two cameras side by side, and the unit of everything that is made from their pictures.

    A rig whose `rotation` is None is rectified: rows of both images correspond and lenses are corrected. With
    `rotation`, `translation` and `distortion` it describes the cameras as they are; `rectify` then precedes matching.

    Attributes:
        focal_px: Focal lengths (fx, fy) of the left camera.
        center_px: Principal point (cx, cy) of the left camera; the middle of the first pixel is (0, 0).
        baseline_m: Distance of the two cameras.
        image_size: Width and height of the images this rig is for; None where the file did not say (not checked then).
        doffs_px: Right principal point's column minus the left one's, for a rectified rig.
        max_disparity_px: Upper bound of the disparities to search, where known (Middlebury's ndisp).
        right_focal_px: Focal lengths of the right camera, not rectified; the left ones where None.
        right_center_px: Principal point of the right camera, not rectified; the left one where None.
        distortion: OpenCV's lens coefficients of the left and the right camera.
        rotation: From left to right camera frame, 3 x 3: x_right = rotation x_left + translation.
        translation: The same in metres; (-baseline, 0, 0) for cameras side by side.
        metric: False where the baseline is only nominal, so that lengths are in arbitrary units.
        calibration: How `calibrate` came to this rig.
    """

    focal_px: tuple[float, float]
    center_px: tuple[float, float]
    baseline_m: float
    image_size: tuple[int, int] | None
    doffs_px: float = 0.0
    max_disparity_px: float | None = None
    right_focal_px: tuple[float, float] | None = None
    right_center_px: tuple[float, float] | None = None
    distortion: tuple[tuple[float, ...], tuple[float, ...]] | None = None
    rotation: tuple[tuple[float, ...], ...] | None = None
    translation: tuple[float, float, float] | None = None
    metric: bool = True
    calibration: "Calibration | None" = None

    def __post_init__(self) -> None:
        _set(self, "focal_px", _vector(self.focal_px, "focal_px", 2, positive=True))
        _set(self, "center_px", _vector(self.center_px, "center_px", 2))
        if self.baseline_m is None:
            raise ValueError(
                "baseline_m must be the distance of the cameras in metres, got None; without it lengths are unknown:"
                " baseline_m=1.0 with metric=False gives arbitrary units"
            )
        _set(self, "baseline_m", _vector([self.baseline_m], "baseline_m", 1, positive=True)[0])
        _set(self, "doffs_px", _vector([self.doffs_px], "doffs_px", 1)[0])
        if self.max_disparity_px is not None:
            _set(self, "max_disparity_px", _vector([self.max_disparity_px], "max_disparity_px", 1, positive=True)[0])
        if self.image_size is not None:
            width, height = _vector(self.image_size, "image_size", 2, positive=True)
            if width % 1 or height % 1:
                raise ValueError(f"image_size must be whole numbers (width, height), got {self.image_size}")
            _set(self, "image_size", (int(width), int(height)))
        for name, positive in (("right_focal_px", True), ("right_center_px", False)):
            if getattr(self, name) is not None:
                _set(self, name, _vector(getattr(self, name), name, 2, positive=positive))
        if not isinstance(self.metric, bool | np.bool_):
            raise ValueError(f"metric must be True or False, got {self.metric!r}")
        _set(self, "metric", bool(self.metric))
        self._check_pose()

    def _check_pose(self) -> None:
        if self.distortion is not None:
            if len(self.distortion) != 2:
                raise ValueError(f"distortion must be two lists, left and right, got {len(self.distortion)}")
            lenses = tuple(tuple(float(value) for value in np.ravel(lens)) for lens in self.distortion)
            if not all(np.isfinite(lens).all() for lens in lenses):
                raise ValueError(f"distortion must be finite, got {lenses}")
            if any(len(lens) not in (0, 4, 5, 8, 12, 14) for lens in lenses):
                raise ValueError(
                    f"distortion must have 4, 5, 8, 12 or 14 coefficients, got {[len(lens) for lens in lenses]}"
                )
            _set(self, "distortion", lenses)
        if (self.rotation is None) != (self.translation is None):
            raise ValueError("rotation and translation must be given together")
        if self.rotation is None or self.translation is None:
            if self.distortion is not None:
                raise ValueError("distortion must come with rotation and translation: such images are not rectified")
            return
        rotation = np.asarray(self.rotation, float)
        orthogonal = rotation.shape == (3, 3) and np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-4)
        if not orthogonal or np.linalg.det(rotation) < 0:
            raise ValueError(f"rotation must be a 3 x 3 rotation matrix, got {rotation.tolist()}")
        _set(self, "rotation", tuple(tuple(row) for row in rotation.tolist()))
        translation = _vector(self.translation, "translation", 3)
        _set(self, "translation", translation)
        if not rigfiles.side_by_side(translation):
            raise ValueError(f"translation must be mainly along x (cameras side by side), got {translation}")
        if translation[0] > 0:
            raise ValueError(
                f"translation must have a negative x (the right camera stands at +x), got {translation}: left and right"
                " are swapped, or the transformation is the inverse"
            )
        length = float(np.linalg.norm(translation))
        if abs(length - self.baseline_m) > 1e-3 * length:
            raise ValueError(f"baseline_m must be the length of translation, {length}, got {self.baseline_m}")

    @property
    def rectified(self) -> bool:
        """Whether rows of both images correspond, so that matching may start."""
        return self.rotation is None

    def scaled(self, to: float | tuple[int, int]) -> "Rig":
        """The rig for resized images: focal lengths, centers and offset change, the baseline does not.

        Args:
            to: A factor for both directions, or the new (width, height).

        Raises:
            ValueError: The factor is not above 0, a size is not of whole pixels, or the rig does not know its own.
        """
        if np.ndim(to) == 0:
            sx = sy = float(checks.number(to, "to", above=0.0))
            size = None if self.image_size is None else (round(self.image_size[0] * sx), round(self.image_size[1] * sy))
        else:
            width, height = _vector(to, "to", 2, positive=True)
            if self.image_size is None:
                raise ValueError("to must be a factor, since this rig does not know its image_size")
            if width % 1 or height % 1:
                raise ValueError(f"to must be a factor or whole numbers (width, height), got {to!r}")
            size = (int(width), int(height))
            sx, sy = width / self.image_size[0], height / self.image_size[1]
            # Sizes of resized images are rounded, by a pixel at most.
            if abs(sx - sy) > 1 / self.image_size[0] + 1 / self.image_size[1]:
                warnings.warn(
                    f"images of {self.image_size[0]} x {self.image_size[1]} are now {size[0]} x {size[1]}, narrower or wider than"
                    " before: if they were cropped, not resized, move center_px in place of scaling",
                    stacklevel=2,
                )

        def focal(pair: tuple[float, float]) -> tuple[float, float]:
            return pair[0] * sx, pair[1] * sy

        def center(pair: tuple[float, float]) -> tuple[float, float]:
            # The middle of the first pixel is 0, so the image's corner, which resizing keeps, is at -1/2.
            return (pair[0] + 0.5) * sx - 0.5, (pair[1] + 0.5) * sy - 0.5

        return dataclasses.replace(
            self,
            focal_px=focal(self.focal_px),
            center_px=center(self.center_px),
            image_size=size,
            doffs_px=self.doffs_px * sx,
            max_disparity_px=None if self.max_disparity_px is None else self.max_disparity_px * sx,
            right_focal_px=None if self.right_focal_px is None else focal(self.right_focal_px),
            right_center_px=None if self.right_center_px is None else center(self.right_center_px),
        )


@dataclasses.dataclass(frozen=True)
class Calibration:
    """How well a rig fits the board photographs it came from.

    Attributes:
        rms_px: Reprojection error of both cameras together, root mean square. Below 0.5 is good, above 1 is not.
        mono_rms_px: The same of the left and the right camera alone.
        pairs: Which pairs were used (positions in the lists given).
        pair_rms_px: Reprojection error of each used pair.
        left_out: Position and reason of each pair that was not used.
    """

    rms_px: float
    mono_rms_px: tuple[float, float]
    pairs: tuple[int, ...]
    pair_rms_px: tuple[float, ...]
    left_out: tuple[tuple[int, str], ...]


def load_rig(
    path: str | os.PathLike[str],
    other: str | os.PathLike[str] | None = None,
    *,
    unit_m: float | None = None,
    rectified: bool = False,
    cameras: tuple[int, int] | None = None,
    arbitrary_units: bool = False,
) -> Rig:
    """Reads a rig from its own JSON, Middlebury calib.txt, KITTI calib.txt, OpenCV FileStorage or ROS camera_info.

    Args:
        path: The file. Of ROS's two files the left one; of OpenCV's two the intrinsics.
        other: The second file of the same rig, where there are two.
        unit_m: Length of the file's unit in metres. By default a millimetre for Middlebury and a metre for all others;
            OpenCV's translation is in whatever unit the squares of the calibration board were given in.
        rectified: The images are rectified already although the file also describes the raw cameras.
        cameras: Which two of KITTI's four, such as (0, 1); by default the colour pair (2, 3), else the grey one (0, 1).
        arbitrary_units: Where the baseline or offset is not in the file, go on with baseline 1 and offset 0; the rig
            then has `metric=False`, lengths mean nothing and an unknown offset bends shapes. The file of a single camera will do
            then, whose depths are metres all the same where a depth camera gives them.

    Returns:
        The rig, in metres; one whose file describes raw cameras is not `rectified`.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: It is not a rig's file, or does not hold what metres need.
    """
    checks.flag(arbitrary_units, "arbitrary_units")
    checks.flag(rectified, "rectified")
    text = _text(path)
    if cameras is not None and np.shape(cameras) != (2,):
        raise TypeError(f"cameras must be two numbers such as (0, 1), got {cameras!r}")
    try:
        unit = None if unit_m is None else _vector([unit_m], "unit_m", 1, positive=True)[0]
        if text.lstrip().startswith("{") and '"schema"' in text:
            given = {"other": other is not None, "cameras": cameras is not None, "rectified": rectified}
            if wrong := [name for name, is_given in given.items() if is_given]:
                raise ValueError(f"is this library's own JSON, which has no use for {' and '.join(wrong)}")
            unit = 1.0 if unit is None else unit
            rig = _in_metres(_from_json(text), unit)
        else:
            second = None if other is None else _text(other)
            fields = rigfiles.parse(text, second, cameras=cameras, rectified=rectified, alone=arbitrary_units)
            of_format = fields.pop("unit_m", 1.0)
            unit = of_format if unit is None else unit
            rig = _from_fields(fields, unit, arbitrary_units)
    except ValueError as error:
        raise ValueError(f"rig {os.fspath(path)} {one_line(error)}") from None
    except (KeyError, TypeError, IndexError, AttributeError, OverflowError, RecursionError) as error:
        raise ValueError(f"rig {os.fspath(path)} is damaged or no calibration file ({type(error).__name__})") from None
    other_unit = 0.001 if unit == 1 else 1
    warn_of_unit(
        rig,
        f"rig {os.fspath(path)}",
        f"its lengths were read in units of {unit:g} m; where that is wrong, say so, for instance unit_m={other_unit}, or --unit"
        f" {other_unit}",
    )
    return rig


def warn_of_unit(rig: Rig, whose: str, advice: str) -> None:
    """Warns where cameras are so near or far from each other that the unit must be another one."""
    if rig.metric and not PLAUSIBLE_BASELINE_M[0] <= rig.baseline_m <= PLAUSIBLE_BASELINE_M[1]:
        warnings.warn(f"{whose} has a baseline of {rig.baseline_m:g} m: {advice}", stacklevel=3)


def save_rig(path: str | os.PathLike[str], rig: Rig) -> None:
    """Writes a rig, whole or not at all, in the format that the name ends in.

    Args:
        path: A file ending in `.json` or in nothing, this library's own, which alone holds everything; in `.yml`, `.yaml` or
            `.xml`, OpenCV's FileStorage, with M1, D1, M2, D2, R and T, or P1, P2 and Q of rectified cameras; or in `.txt`,
            Middlebury's `calib.txt` (lengths in millimetres) of rectified ones.
        rig: The rig.

    Raises:
        OSError: The folder does not exist or cannot be written.
        ValueError: The name ends in something else, or such a file cannot hold this rig.
        TypeError: It is no rig.
    """
    fields = fields_of(checks.kind(rig, "rig", Rig, "load_rig reads one from a file"))
    write_atomic(path, written(fields, Path(path).suffix.lower()).encode())


def fields_of(rig: Rig) -> rigfiles.Fields:
    """The fields of a rig that are known."""
    return {name: value for name, value in dataclasses.asdict(rig).items() if value is not None}


def _from_fields(fields: rigfiles.Fields, unit: float, arbitrary_units: bool) -> Rig:
    """The rig in metres."""
    missing = [name for name in ("baseline_m", "doffs_px") if fields.get(name) is None]
    if missing and not arbitrary_units:
        words = " and no ".join(name.removesuffix("_m").removesuffix("_px") for name in missing)
        raise ValueError(
            f"holds no {words}, without which lengths in metres are unknown; arbitrary_units=True, or --arbitrary-units, goes on"
            " without"
        )
    if "baseline_m" in missing:
        fields["baseline_m"], unit = 1.0, 1.0
    if "doffs_px" in missing:
        fields["doffs_px"] = 0.0
    if fields["baseline_m"] <= 0:
        raise ValueError(
            f"has the baseline {fields['baseline_m']}, which is not above 0: left and right are swapped, or the"
            " transformation is the inverse"
        )
    return _in_metres(Rig(**fields, metric=not missing), unit)


def _in_metres(rig: Rig, unit: float) -> Rig:
    """A rig whose lengths are in another unit."""
    moved = None if rig.translation is None else tuple(np.asarray(rig.translation) * unit)
    return dataclasses.replace(rig, baseline_m=rig.baseline_m * unit, translation=moved)


def _from_json(text: str) -> Rig:
    try:
        tree = json.loads(text)
    except json.JSONDecodeError as error:
        raise ValueError(f"is not valid JSON ({error})") from None
    if tree.pop("schema", None) != SCHEMA:
        raise ValueError(f"is JSON of another kind: schema must be {SCHEMA!r}")
    version = tree.pop("version", None)
    if version != VERSION:
        raise ValueError(f"has version {version!r}, only {VERSION} is known here")
    names = {field.name: field for field in dataclasses.fields(Rig)}
    if unknown := sorted(tree.keys() - names.keys()):
        raise ValueError(f"has unknown fields: {', '.join(unknown)}")
    tree.setdefault("image_size", None)
    required = [name for name, field in names.items() if field.default is dataclasses.MISSING]
    if missing := [name for name in required if name not in tree]:
        raise ValueError(f"lacks the fields: {', '.join(missing)}")
    if tree.get("calibration") is not None:
        entries = {name: _tuples(value) for name, value in tree["calibration"].items()}
        tree["calibration"] = Calibration(**entries)
    return Rig(**tree)


def _tuples(value: Any) -> Any:
    return tuple(_tuples(item) for item in value) if isinstance(value, list) else value


def _text(path: str | os.PathLike[str]) -> str:
    data = read_bytes(path, "rig")
    if len(data) > LARGEST_FILE:
        raise ValueError(f"rig {os.fspath(path)} has {len(data)} bytes, no calibration has more than {LARGEST_FILE}")
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError:
        raise ValueError(f"rig {os.fspath(path)} is no text file, so no calibration") from None


def _vector(value: Any, name: str, count: int, *, positive: bool = False) -> tuple[Any, ...]:
    try:
        array = np.asarray(value, float)
    except (TypeError, ValueError):
        array = np.zeros(0)
    if array.shape != (count,):
        shown = value[0] if count == 1 else value
        raise ValueError(f"{name} must be {'one number' if count == 1 else f'{count} numbers'}, got {shown!r}")
    if not np.all(np.isfinite(array)) or (positive and not np.all(array > 0)):
        raise ValueError(f"{name} must be finite{' and above 0' * positive}, got {value!r}")
    return tuple(array.tolist())


def _set(rig: Rig, name: str, value: Any) -> None:
    object.__setattr__(rig, name, value)
