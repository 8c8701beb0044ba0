"""Models of a surface in one camera's picture, fitted to noisy samples of its inverse depth.

On a plane, inverse depth is linear in the pixel. The models are a plane, planes that meet in an edge or a
corner, a quadric, and B-splines.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import BSpline

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Parts = NDArray[np.int64]

MIN_SAMPLES = 12
"""Smallest number of samples for a model."""

_REWEIGHTINGS = 8  # iterations of robust least squares
_SPLINE_CELLS = (2, 4, 8)  # cells of the B-splines along the longer side of the paint
_BEND_SHARE = 1e-3  # weight of the splines' bending, as a share of the squared residuals
_PLANES_NAMES = {1: "a plane", 2: "2 planes that meet in an edge", 3: "3 planes that meet in a corner"}
_ROUNDINGS = (0.1, 0.3, 1.0)  # tried roundings of edges, as shares of the spread between the planes
_ROUNDING_STEPS = 3  # Gauss-Newton steps, from the planes of a sharp edge
_EDGE_DIRECTIONS = 6  # tried directions of an edge between planes
_DIFFERENCE = 1e-4  # step of numeric derivatives in normalized image coordinates
_SAMPLES_PER_TERM = 8  # smallest number of samples per coefficient of a spline


@dataclass(frozen=True)
class Samples:
    """Points of a surface in the image coordinates (column − cx) / fx and (row − cy) / fy of a camera."""

    x: Array  # [S]
    y: Array  # [S]
    inverse: Array  # inverse depth. [S]
    focal: float  # focal length, pixels

    def __len__(self) -> int:
        return len(self.x)

    def select(self, chosen: Mask) -> Samples:
        """Return some of the samples. [S] bool"""
        return Samples(self.x[chosen], self.y[chosen], self.inverse[chosen], self.focal)

    def residuals(self, model: SurfaceModel) -> Array:
        """Return the distances of the samples in front of the model, in pixels at their depth. [S]"""
        difference: Array = (self.inverse - model.inverse_depth(self.x, self.y)) / self.inverse * self.focal
        return difference


def join_samples(parts: Sequence[Samples]) -> Samples:
    """Return all samples of several parts, in one camera's coordinates."""
    x, y, inverse = (
        np.concatenate([getattr(part, name) for part in parts]) for name in ("x", "y", "inverse")
    )
    return Samples(x, y, inverse, parts[0].focal)


class SurfaceModel(Protocol):
    """Inverse depth as a function of normalized image coordinates."""

    @property
    def name(self) -> str:
        """Name of the model in the log."""
        ...

    def inverse_depth(self, x: Array, y: Array) -> Array:
        """Return 1 / depth at image coordinates (column − cx) / fx and (row − cy) / fy. Any shape."""
        ...

    def part(self, x: Array, y: Array) -> Parts:
        """Return the index of the smooth part at image coordinates; 0 for a model without edges."""
        ...

    def gradient(self, x: Array, y: Array) -> tuple[Array, Array]:
        """Return the derivatives of the inverse depth by x and by y at image coordinates."""
        ...


@dataclass(frozen=True)
class Planes:
    """Planes that meet in convex edges (the farthest is visible) or concave ones (the nearest).

    A rounded edge is the smooth minimum or maximum of the planes.
    """

    coefficients: Array  # inverse depth a + b x + c y of each plane. [K,3]
    is_convex: bool = True
    rounding: float = 0.0  # difference of inverse depths below which an edge is rounded; 0: sharp

    @property
    def name(self) -> str:
        """See `SurfaceModel`."""
        name = _PLANES_NAMES[len(self.coefficients)]
        return f"{name}, rounded" if self.rounding else name

    def values(self, x: Array, y: Array) -> Array:
        """Return the inverse depth of each plane. [K,...]"""
        a, b, c = self.coefficients.T
        values: Array = np.add.outer(a, np.zeros_like(x))
        values += np.multiply.outer(b, x) + np.multiply.outer(c, y)
        return values

    def shares(self, x: Array, y: Array) -> Array:
        """Return the share of each plane in the surface's gradient; 0 and 1 for sharp edges. [K,...]"""
        values = self.values(x, y)
        if not self.rounding:
            planes = np.arange(len(values)).reshape(-1, *np.ones(np.ndim(x), int))
            return np.asarray(planes == self._visible(values), np.float64)
        exponents = self._exponents(values)
        weights = np.exp(exponents - exponents.max(axis=0))
        return np.asarray(weights / weights.sum(axis=0), np.float64)

    def _exponents(self, values: Array) -> Array:
        sign = -1.0 if self.is_convex else 1.0
        exponents: Array = sign * values / self.rounding
        return exponents

    def _visible(self, values: Array) -> Parts:
        visible: Parts = values.argmin(axis=0) if self.is_convex else values.argmax(axis=0)
        return visible

    def inverse_depth(self, x: Array, y: Array) -> Array:
        """See `SurfaceModel`."""
        values = self.values(x, y)
        if not self.rounding:
            chosen: Array = values.min(axis=0) if self.is_convex else values.max(axis=0)
            return chosen
        smooth: Array = self.rounding * np.logaddexp.reduce(self._exponents(values), axis=0)
        return -smooth if self.is_convex else smooth

    def part(self, x: Array, y: Array) -> Parts:
        """See `SurfaceModel`."""
        if self.rounding:
            return np.zeros(np.shape(x), np.int64)
        return self._visible(self.values(x, y))

    def visible_plane(self, x: Array, y: Array) -> Parts:
        """Return the index of the plane that is visible, or nearest to the rounded surface."""
        return self._visible(self.values(x, y))

    def gradient(self, x: Array, y: Array) -> tuple[Array, Array]:
        """See `SurfaceModel`."""
        shares = self.shares(x, y)
        by_x: Array = np.tensordot(self.coefficients[:, 1], shares, 1)
        by_y: Array = np.tensordot(self.coefficients[:, 2], shares, 1)
        return by_x, by_y


@dataclass(frozen=True)
class Quadric:
    """Inverse depth as a polynomial of degree two."""

    coefficients: Array  # of 1, x, y, x², xy, y². [6]
    name: str = "a curved surface of degree 2"

    def inverse_depth(self, x: Array, y: Array) -> Array:
        """See `SurfaceModel`."""
        terms = _quadratic_terms(x.ravel(), y.ravel())
        values: Array = (terms @ self.coefficients).reshape(x.shape)
        return values

    def part(self, x: Array, y: Array) -> Parts:
        """See `SurfaceModel`."""
        return np.zeros(x.shape, np.int64)

    def gradient(self, x: Array, y: Array) -> tuple[Array, Array]:
        """See `SurfaceModel`."""
        return _numeric_gradient(self.inverse_depth, x, y)


@dataclass(frozen=True)
class Spline:
    """Inverse depth as a plane plus a cubic B-spline; beyond the box of the samples its border continues."""

    plane: Planes
    heights: Array  # coefficients of the B-splines. [rows,columns]
    box: tuple[float, float, float, float]  # x and y minimum, x and y maximum
    cells: int  # cells along the longer side

    @property
    def name(self) -> str:
        """See `SurfaceModel`."""
        return f"a smooth surface of {self.cells} cells along its longer side"

    def inverse_depth(self, x: Array, y: Array) -> Array:
        """See `SurfaceModel`."""
        shape = (self.heights.shape[1] - 3, self.heights.shape[0] - 3)
        flat_x = x.ravel()
        flat_y = y.ravel()
        columns = _spline_basis(flat_x, self.box[0], self.box[2], shape[0])
        rows = _spline_basis(flat_y, self.box[1], self.box[3], shape[1])
        raised = np.einsum("ni,ij,nj->n", rows, self.heights, columns)
        values: Array = self.plane.inverse_depth(x, y) + raised.reshape(x.shape)
        return values

    def part(self, x: Array, y: Array) -> Parts:
        """See `SurfaceModel`."""
        return np.zeros(x.shape, np.int64)

    def gradient(self, x: Array, y: Array) -> tuple[Array, Array]:
        """See `SurfaceModel`."""
        return _numeric_gradient(self.inverse_depth, x, y)


def _numeric_gradient(
    inverse_depth: Callable[[Array, Array], Array], x: Array, y: Array
) -> tuple[Array, Array]:
    """Return central differences of an inverse depth by x and by y."""
    step = _DIFFERENCE
    by_x = inverse_depth(x + step, y) - inverse_depth(x - step, y)
    by_y = inverse_depth(x, y + step) - inverse_depth(x, y - step)
    return by_x / (2 * step), by_y / (2 * step)


ModelMaker = Callable[[Samples], SurfaceModel]


def model_makers(samples: Samples) -> Iterator[Sequence[ModelMaker]]:
    """Yield groups of functions that fit models to samples. Models of one group have as many coefficients.

    The simplest group comes first.

    Args:
        samples: all samples; splines span their box, even if some are left out of a fit
    """
    yield [fit_planes]
    yield [fit_quadric, *(partial(fit_planes, count=2, is_convex=convex) for convex in (True, False))]
    yield [partial(fit_planes, count=3, is_convex=convex) for convex in (True, False)]
    for cells in _SPLINE_CELLS:
        if len(samples) >= _SAMPLES_PER_TERM * (cells + 3) ** 2:
            yield [partial(fit_spline, cells=cells, box=box_of(samples))]


def deviation(residuals: Array) -> float:
    """Return the standard deviation of residuals, estimated from their median."""
    return float(1.4826 * np.median(np.abs(residuals)))


def _robust(
    terms: Array, samples: Samples, wanted: Array | None = None, penalty: Array | None = None
) -> Array:
    """Return coefficients of terms by iteratively reweighted least squares (Cauchy). [S,T] -> [T]

    Residuals are weighted in pixels at the samples' depth.

    Args:
        terms: values of the terms at the samples. [S,T]
        samples: the samples
        wanted: values to fit; None: the inverse depths. [S]
        penalty: quadratic form that is added, as a share of the terms' own. [T,T]
    """
    unit = samples.focal / samples.inverse
    weights = np.ones(len(samples))
    coefficients = np.zeros(terms.shape[1])
    scaled = terms * unit[:, None]
    wanted = (samples.inverse if wanted is None else wanted) * unit
    for _ in range(_REWEIGHTINGS):
        left = scaled * weights[:, None]
        normal = left.T @ scaled
        if penalty is not None:
            normal = normal + penalty * (_BEND_SHARE * np.trace(normal) / np.trace(penalty))
        scale = np.sqrt(np.maximum(np.diag(normal), 1e-30))
        normal = normal / scale[:, None] / scale
        normal[np.diag_indices_from(normal)] += 1e-10
        coefficients = np.linalg.solve(normal, (left.T @ wanted) / scale) / scale
        residuals = wanted - scaled @ coefficients
        spread = max(deviation(residuals), 1e-3)
        weights = 1.0 / (1.0 + (residuals / (2.0 * spread)) ** 2)
    return coefficients


def linear_terms(x: Array, y: Array) -> Array:
    """Return 1, x and y of samples. [S,3]"""
    return np.stack([np.ones_like(x), x, y], axis=1)


def _quadratic_terms(x: Array, y: Array) -> Array:
    return np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=1)


def fit_planes(samples: Samples, count: int = 1, is_convex: bool = True) -> Planes:
    """Fit planes that meet in edges, from several first divisions of the samples."""
    first = Planes(_robust(linear_terms(samples.x, samples.y), samples)[None])
    if count == 1:
        return first
    best = first
    lowest = math.inf
    for division in divisions(samples, count):
        found = _fit_divided(samples, division, count, is_convex)
        if found is None:
            continue
        error = mean_distance(samples, found)
        if error < lowest:
            best = found
            lowest = error
    return _round_edges(samples, best)


def mean_distance(samples: Samples, model: SurfaceModel) -> float:
    """Return the mean distance of samples from a model, in pixels."""
    return float(np.abs(samples.residuals(model)).mean())


def _round_edges(samples: Samples, sharp: Planes) -> Planes:
    """Return the planes with the edges' rounding that fits the samples best, from sharp to a smooth bend."""
    values = sharp.values(samples.x, samples.y)
    spread = float((values.max(axis=0) - values.min(axis=0)).std())
    best = sharp
    lowest = mean_distance(samples, sharp)
    for share in _ROUNDINGS:
        found = _fit_rounded(samples, replace(sharp, rounding=share * spread))
        error = mean_distance(samples, found)
        if error < lowest:
            best = found
            lowest = error
    return best


def _fit_rounded(samples: Samples, start: Planes) -> Planes:
    """Fit planes with rounded edges by Gauss-Newton steps."""
    planes = start
    terms = linear_terms(samples.x, samples.y)
    for _ in range(_ROUNDING_STEPS):
        shares = planes.shares(samples.x, samples.y)
        jacobian = (shares.T[:, :, None] * terms[:, None, :]).reshape(len(samples), -1)
        flat = planes.coefficients.ravel()
        wanted = samples.inverse - planes.inverse_depth(samples.x, samples.y) + jacobian @ flat
        planes = replace(planes, coefficients=_robust(jacobian, samples, wanted).reshape(-1, 3))
    return planes


def divisions(samples: Samples, count: int) -> Iterator[Parts]:
    """Yield divisions of the samples into parts: stripes or sectors in several directions. [S] each"""
    x = samples.x - np.median(samples.x)
    y = samples.y - np.median(samples.y)
    half_turn = count == 2  # an edge is the same after half a turn
    directions = _EDGE_DIRECTIONS if half_turn else 2 * _EDGE_DIRECTIONS
    for step in range(directions):
        angle = math.pi * step / _EDGE_DIRECTIONS
        if half_turn:
            yield (np.cos(angle) * x + np.sin(angle) * y > 0).astype(np.int64)
        else:
            turned = np.arctan2(y, x) - angle
            yield (np.floor(turned / (2 * math.pi / count)) % count).astype(np.int64)


def _fit_divided(samples: Samples, division: Parts, count: int, is_convex: bool) -> Planes | None:
    """Fit planes to a division, and divide the samples again by the visible plane, until nothing changes."""
    planes = None
    for _ in range(_REWEIGHTINGS):
        parts = [samples.select(division == k) for k in range(count)]
        if min(len(part) for part in parts) < MIN_SAMPLES:
            return None
        planes = Planes(np.array([_robust(linear_terms(p.x, p.y), p) for p in parts]), is_convex)
        visible = planes.visible_plane(samples.x, samples.y)
        if np.array_equal(visible, division):
            break
        division = visible
    return planes


def fit_quadric(samples: Samples) -> Quadric:
    """Fit a quadric."""
    return Quadric(_robust(_quadratic_terms(samples.x, samples.y), samples))


def box_of(samples: Samples) -> tuple[float, float, float, float]:
    """Return the smallest x and y and the largest x and y of samples."""
    return tuple(  # type: ignore[return-value]
        float(edge(values)) for edge in (np.min, np.max) for values in (samples.x, samples.y)
    )


def _spline_basis(values: Array, low: float, high: float, cells: int) -> Array:
    """Return the cubic B-splines of a coordinate, which is clamped to the box. [S] -> [S,cells+3]"""
    step = (high - low) / cells
    knots = low + step * np.arange(-3, cells + 4)
    inside = np.clip(values, low, high - 1e-9 * step)
    return np.asarray(BSpline.design_matrix(inside, knots, 3).toarray())


def fit_spline(samples: Samples, cells: int, box: tuple[float, float, float, float]) -> Spline:
    """Fit a plane and B-splines whose curvature is penalized slightly, so that gaps are bridged smoothly."""
    plane = fit_planes(samples)
    width = max(box[2] - box[0], 1e-9)
    height = max(box[3] - box[1], 1e-9)
    longer = max(width, height)
    counts = [max(1, round(cells * side / longer)) for side in (width, height)]
    columns = _spline_basis(samples.x, box[0], box[2], counts[0])
    rows = _spline_basis(samples.y, box[1], box[3], counts[1])
    terms = (rows[:, :, None] * columns[:, None, :]).reshape(len(samples), -1)
    bends = [np.diff(np.eye(count + 3), n=2, axis=0) for count in (counts[1], counts[0])]
    across = [np.eye(count + 3) for count in (counts[1], counts[0])]
    penalty = np.kron(bends[0].T @ bends[0], across[1]) + np.kron(across[0], bends[1].T @ bends[1])
    beyond_plane = samples.inverse - plane.inverse_depth(samples.x, samples.y)
    heights = _robust(terms, samples, beyond_plane, penalty)
    return Spline(plane, heights.reshape(rows.shape[1], columns.shape[1]), box, cells)
