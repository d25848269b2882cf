"""Data passed between the packages: frames, and image coordinates in columns."""

from __future__ import annotations

from collections.abc import Hashable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .arrays import Array, Mask, Rows, rows_of_groups
from .display import Display
from .errors import ImageError, UsageError
from .files import write_whole
from .tone import ToneCurve

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["Array", "Mask", "Rows", "filters_of", "rows_of_groups"]


def filters_of(pattern: str) -> str:
    """Return the pattern of a cell of 2 × 2 pixels if it has two green filters, a red and a blue one.

    Examples
    --------
    >>> filters_of("GRBG"), filters_of("BGRA")
    ('GRBG', '')
    """
    return pattern if "".join(sorted(pattern)) == "BGGR" else ""


@dataclass(frozen=True, eq=False, repr=False)
class Frame(Display):
    """One grey image from an instrument or a file, with unchanged grey values.

    Parameters
    ----------
    pixels : ndarray (height, width)
        Grey values, unsigned integers or floats, never rescaled. Pixel coordinates have their origin at the
        centre of the top-left pixel, x right, y down.
    full_scale : float
        The grey value at which the sensor or the file saturates: 255 for 8 bits.
    name : str
        Name in messages and results, usually a file name.
    sha256 : str
        Hash of the file, or of the pixels where there is no file.
    notes : tuple of str
        What a user should know about how it was read.
    curve : ToneCurve, optional
        Curve between grey values and light that the file states; None if it states none.
    filters : str
        Colour filters of the pixels of the first two rows, as RGGB, where they are known; else empty.

    Raises
    ------
    ImageError
        When the pixels are not a grey image of at least 2×2, or contain values that are not finite.

    Examples
    --------
    >>> frame = Frame(np.zeros((480, 640), np.uint8), 255.0, "left.png")
    >>> frame.width, frame.height
    (640, 480)
    """

    pixels: NDArray[Any]
    full_scale: float
    name: str = "frame"
    sha256: str = ""
    notes: tuple[str, ...] = ()
    curve: ToneCurve | None = None
    filters: str = ""

    def __post_init__(self) -> None:
        if self.pixels.ndim != 2 or min(self.pixels.shape) < 2:
            raise ImageError(
                f"has the shape {self.pixels.shape}; a grey image has (height, width)", where=self.name
            )
        if self.pixels.dtype.kind == "f" and not np.isfinite(self.pixels).all():
            raise ImageError("contains grey values that are not finite", where=self.name)

    def _facts(self) -> list[tuple[str, str]]:
        return [
            ("name", self.name),
            ("size", f"{self.width} × {self.height} px"),
            ("type", str(self.pixels.dtype)),
            ("full scale", f"{self.full_scale:g}"),
        ]

    def plot(self, axes: Axes | None = None) -> Axes:
        """Draw the image with matplotlib.

        Parameters
        ----------
        axes : matplotlib Axes, optional
            Axes to draw into; by default those of a new figure.
        """
        from .figures import over_picture

        axes = over_picture(axes, self.pixels)
        axes.set_title(self.name, loc="left")
        return axes

    @property
    def width(self) -> int:
        """Number of columns."""
        return int(self.pixels.shape[1])

    @property
    def height(self) -> int:
        """Number of rows."""
        return int(self.pixels.shape[0])


H = TypeVar("H", bound=Hashable)


def twice(names: Iterable[H]) -> H | None:
    """The first name that occurs a second time; None without one.

    Examples
    --------
    >>> twice(["a", "b", "a"])
    'a'
    """
    seen: set[H] = set()
    for name in names:
        if name in seen:
            return name
        seen.add(name)
    return None


def covariances_of(sx: ArrayLike, sy: ArrayLike, rho: ArrayLike = 0.0) -> Array:
    """Covariance matrices (n, 2, 2) of standard deviations and correlations (n,).

    Examples
    --------
    >>> covariances_of([2.0], [3.0], [0.5])
    array([[[4., 3.],
            [3., 9.]]])
    """
    x, y, r = np.broadcast_arrays(*(np.asarray(each, dtype=np.float64) for each in (sx, sy, rho)))
    both = r * x * y
    return np.stack([x * x, both, both, y * y], axis=-1).reshape(*x.shape, 2, 2)


def sigmas_of(cov: Array) -> tuple[Array, Array, Array]:
    """Standard deviations in x and y, and correlations (n,), of covariance matrices (n, 2, 2).

    Examples
    --------
    >>> [float(each[0]) for each in sigmas_of(np.array([[[4.0, 3.0], [3.0, 9.0]]]))]
    [2.0, 3.0, 0.5]
    """
    sx, sy = np.sqrt(cov[..., 0, 0]), np.sqrt(cov[..., 1, 1])
    with np.errstate(invalid="ignore", divide="ignore"):
        return sx, sy, cov[..., 0, 1] / (sx * sy)


@dataclass(frozen=True, eq=False, repr=False)
class ImagePoints(Display):
    """Named points in a plane with their covariances, in columns.

    Parameters
    ----------
    names : tuple of str (n,)
        Unique names.
    xy : ndarray (n, 2)
        Coordinates: pixels in an image, millimetres for photo-coordinates.
    cov : ndarray (n, 2, 2)
        Covariance matrices of the points, in the squared unit of `xy`.

    Raises
    ------
    UsageError
        When the columns differ in length or a name occurs twice.

    Examples
    --------
    >>> points = ImagePoints.with_sigma(["a", "b"], [[1.0, 2.0], [3.0, 4.0]], 0.02)
    >>> points.select(["b"]).xy
    array([[3., 4.]])
    """

    names: tuple[str, ...]
    xy: Array
    cov: Array

    def __post_init__(self) -> None:
        n = len(self.names)
        if self.xy.shape != (n, 2) or self.cov.shape != (n, 2, 2):
            raise UsageError(f"{n} names with coordinates {self.xy.shape} and covariances {self.cov.shape}")
        if len(set(self.names)) != n:
            twice = next(name for i, name in enumerate(self.names) if name in self.names[:i])
            raise UsageError("occurs twice among the points", where=twice)

    @classmethod
    def with_sigma(cls, names: Iterable[str], xy: ArrayLike, sigma: ArrayLike) -> Self:
        """Points with uncorrelated coordinates; `sigma` broadcasts to (n, 2)."""
        names, points = tuple(names), np.asarray(xy, dtype=np.float64).reshape(-1, 2)
        cov = np.zeros((len(points), 2, 2))
        cov[:, [0, 1], [0, 1]] = np.broadcast_to(np.asarray(sigma, dtype=np.float64) ** 2, points.shape)
        return cls(names, points, cov)

    def __len__(self) -> int:
        return len(self.names)

    @property
    def sigma(self) -> Array:
        """Standard deviations of the coordinates, (n, 2)."""
        return np.sqrt(np.diagonal(self.cov, axis1=1, axis2=2))

    def _facts(self) -> list[tuple[str, str]]:
        if not len(self):
            return [("points", "0")]
        low, high = self.xy.min(axis=0), self.xy.max(axis=0)
        return [
            ("points", str(len(self))),
            ("x", f"{low[0]:.6g} to {high[0]:.6g}"),
            ("y", f"{low[1]:.6g} to {high[1]:.6g}"),
            ("median sigma", f"{np.median(self.sigma):.2g}"),
        ]

    def _columns(self) -> dict[str, list[Any]]:
        columns = np.column_stack([self.xy, *sigmas_of(self.cov)]).T.tolist()
        return {"id": list(self.names)} | dict(zip(("x", "y", "sx", "sy", "rho"), columns, strict=True))

    def plot(self, axes: Axes | None = None, *, y_down: bool = True) -> Axes:
        """Draw the points with their standard ellipses, enlarged, with matplotlib.

        Parameters
        ----------
        axes : matplotlib Axes, optional
            Axes to draw into; by default those of a new figure.
        y_down : bool
            Direction of the y-axis: down in images, up in object space.
        """
        from .figures import BLUE, draw_ellipses, over_picture

        axes = over_picture(axes, y_down=y_down)
        axes.plot(*self.xy.T, ".", color=BLUE, markersize=3)
        axes.margins(0.08)
        enlarged = draw_ellipses(axes, self.xy, self.cov)
        axes.set_title(f"{len(self)} points, ellipses × {enlarged:g}", loc="left")
        return axes

    def write(self, path: Path | str) -> None:
        """Write the points as CSV ``id,x,y,sx,sy``.

        Raises
        ------
        InputError
            When the file cannot be written.
        """
        write_whole(Path(path), self.to_csv())

    def to_csv(self, xy: str = ".7f", sigma: str = ".3e", rho: str = "") -> str:
        """The points as lines ``id,x,y,sx,sy``, also with ``rho`` where there is a format for it."""
        forms = {"x": xy, "y": xy, "sx": sigma, "sy": sigma} | ({"rho": rho} if rho else {})
        values = np.column_stack([self.xy, self.sigma, np.nan_to_num(sigmas_of(self.cov)[2])]).tolist()
        lines = [",".join(("id", *forms))]
        for name, row in zip(self.names, values, strict=True):
            lines.append(",".join((name, *map(format, row, forms.values()))))
        return "\n".join(lines) + "\n"

    def select(self, keep: Sequence[str] | Mask) -> ImagePoints:
        """The points of these names, in their order, or those of a mask (n,).

        Raises
        ------
        UsageError
            When a name is not among the points.
        """
        if isinstance(keep, np.ndarray) and keep.dtype == bool:
            rows = np.flatnonzero(keep)
        else:
            row_of = {name: i for i, name in enumerate(self.names)}
            missing = [str(name) for name in keep if name not in row_of]
            if missing:
                raise UsageError("is not among the points", where=", ".join(missing[:5]))
            rows = np.array([row_of[name] for name in keep], dtype=np.intp)
        return ImagePoints(tuple(self.names[i] for i in rows), self.xy[rows], self.cov[rows])
