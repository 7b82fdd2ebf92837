"""Perspective and fisheye cameras with OpenCV distortion.

Camera frame: +x right, +y down, +z forward. Pixel coordinates: the centre of the top-left pixel is
at (0.5, 0.5). The distortion models are OpenCV's radial-tangential one (`calib3d`) and its fisheye
one (a polynomial in the angle from the axis), which COLMAP and nerfstudio share.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

NEWTON_STEPS = 25


@dataclass(frozen=True)
class Camera:
    """Intrinsics of one camera.

    Attributes:
        width: Image width, pixels, > 0.
        height: Image height, pixels, > 0.
        fx: Horizontal focal length, pixels, > 0.
        fy: Vertical focal length, pixels, > 0.
        cx: Principal point, pixels from the left edge.
        cy: Principal point, pixels from the top edge.
        k1: Radial distortion, no unit.
        k2: Radial distortion, no unit.
        k3: Radial distortion, no unit.
        k4: Fourth fisheye coefficient, no unit; 0 unless `fisheye`.
        p1: Tangential distortion, no unit; 0 for a fisheye.
        p2: Tangential distortion, no unit; 0 for a fisheye.
        fisheye: True for OpenCV's fisheye model (theta polynomial k1..k4), False for its
            radial-tangential model (k1, k2, p1, p2, k3).
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    k1: float = 0.0
    k2: float = 0.0
    k3: float = 0.0
    k4: float = 0.0
    p1: float = 0.0
    p2: float = 0.0
    fisheye: bool = False

    def resized(self, width: int, height: int) -> Camera:
        """The same camera with its image resampled to `width` x `height` pixels."""
        sx, sy = width / self.width, height / self.height
        return replace(
            self,
            width=int(width),
            height=int(height),
            fx=self.fx * sx,
            fy=self.fy * sy,
            cx=self.cx * sx,
            cy=self.cy * sy,
        )

    @property
    def matrix(self) -> Float[np.ndarray, "3 3"]:
        """The pinhole part K, pixels."""
        return np.array([[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1.0]])

    @property
    def distorted(self) -> bool:
        """Whether straight lines are bent in the image."""
        return self.fisheye or any((self.k1, self.k2, self.k3, self.k4, self.p1, self.p2))

    def pixel_centres(self) -> Float[np.ndarray, "h w 2"]:
        """(x, y) of every pixel's centre, pixels."""
        x, y = np.meshgrid(np.arange(self.width) + 0.5, np.arange(self.height) + 0.5)
        return np.stack([x, y], axis=-1)

    def directions(
        self, pixels: Float[np.ndarray, "*n 2"] | None = None
    ) -> Float[np.ndarray, "*n 3"]:
        """Unit directions, in the camera's frame, of the rays through pixel coordinates.

        Args:
            pixels: (x, y) in pixels; None means all pixel centres, shape (h, w, 2).

        Returns:
            float32 unit vectors. Where the distortion has no inverse (outside the range in which
            it is monotonic) the nearest point that Newton's method found is used.
        """
        if pixels is None:
            pixels = self.pixel_centres()
        pixels = np.asarray(pixels, dtype=np.float64)
        distorted = (pixels - (self.cx, self.cy)) / (self.fx, self.fy)
        if self.fisheye:
            rays = _fisheye_rays(distorted, (self.k1, self.k2, self.k3, self.k4))
        else:
            flat = self._undistort(distorted) if self.distorted else distorted
            rays = np.concatenate([flat, np.ones_like(flat[..., :1])], axis=-1)
            rays = rays / np.linalg.norm(rays, axis=-1, keepdims=True)
        return rays.astype(np.float32)

    def project(self, points: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 2"]:
        """Pixel coordinates of points given in the camera's frame.

        Points that the model cannot see (behind a perspective camera, or at its centre) give NaN.
        """
        points = np.asarray(points, dtype=np.float64)
        x, y, z = points[..., 0], points[..., 1], points[..., 2]
        if self.fisheye:
            radius = np.hypot(x, y)
            theta = np.arctan2(radius, z)
            bent = _theta_polynomial(theta, (self.k1, self.k2, self.k3, self.k4))
            # On the axis bent / radius is 0 / 0; the image point is the principal point there.
            ratio = np.where(radius > 0, bent / np.where(radius > 0, radius, 1.0), 0.0)
            ratio = np.where((radius == 0) & (z <= 0), np.nan, ratio)
            flat = np.stack([x * ratio, y * ratio], axis=-1)
        else:
            depth = np.where(z > 0, z, np.nan)
            flat = self._distort(np.stack([x / depth, y / depth], axis=-1))
        return flat * (self.fx, self.fy) + (self.cx, self.cy)

    def _distort(self, flat: Float[np.ndarray, "*n 2"]) -> Float[np.ndarray, "*n 2"]:
        x, y = flat[..., 0], flat[..., 1]
        r2 = x * x + y * y
        radial = 1 + r2 * (self.k1 + r2 * (self.k2 + r2 * self.k3))
        return np.stack(
            [
                x * radial + 2 * self.p1 * x * y + self.p2 * (r2 + 2 * x * x),
                y * radial + self.p1 * (r2 + 2 * y * y) + 2 * self.p2 * x * y,
            ],
            axis=-1,
        )

    def _undistort(self, target: Float[np.ndarray, "*n 2"]) -> Float[np.ndarray, "*n 2"]:
        """Newton's method on `_distort(flat) = target`, started at the target."""
        flat = target.copy()
        best, best_error = flat, np.full(target.shape[:-1], np.inf)
        for _ in range(NEWTON_STEPS):
            residual = self._distort(flat) - target
            error = np.abs(residual).max(axis=-1)
            better = error < best_error
            best = np.where(better[..., None], flat, best)
            best_error = np.where(better, error, best_error)
            if best_error.max(initial=0.0) < 1e-10:
                break
            flat = flat - self._newton_step(flat, residual)
        return best

    def _newton_step(
        self, flat: Float[np.ndarray, "*n 2"], residual: Float[np.ndarray, "*n 2"]
    ) -> Float[np.ndarray, "*n 2"]:
        x, y = flat[..., 0], flat[..., 1]
        r2 = x * x + y * y
        radial = 1 + r2 * (self.k1 + r2 * (self.k2 + r2 * self.k3))
        slope = 2 * (self.k1 + r2 * (2 * self.k2 + 3 * r2 * self.k3))
        xx = radial + slope * x * x + 2 * self.p1 * y + 6 * self.p2 * x
        yy = radial + slope * y * y + 6 * self.p1 * y + 2 * self.p2 * x
        xy = slope * x * y + 2 * self.p1 * x + 2 * self.p2 * y
        determinant = xx * yy - xy * xy
        # Past the fold of the distortion the Jacobian is singular or turned: step as if it were 1.
        safe = np.where(determinant > 1e-3, determinant, 1.0)
        step = np.stack(
            [
                (yy * residual[..., 0] - xy * residual[..., 1]) / safe,
                (xx * residual[..., 1] - xy * residual[..., 0]) / safe,
            ],
            axis=-1,
        )
        step = np.where((determinant > 1e-3)[..., None], step, residual)
        # Half a focal length a step keeps a bad start from being thrown out of the picture.
        return np.clip(step, -0.5, 0.5)


def _theta_polynomial(theta: np.ndarray, k: tuple[float, float, float, float]) -> np.ndarray:
    t2 = theta * theta
    return theta * (1 + t2 * (k[0] + t2 * (k[1] + t2 * (k[2] + t2 * k[3]))))


def _fisheye_rays(
    distorted: Float[np.ndarray, "*n 2"], k: tuple[float, float, float, float]
) -> Float[np.ndarray, "*n 3"]:
    radius = np.linalg.norm(distorted, axis=-1)
    theta = np.minimum(radius, np.pi)
    best, best_error = theta, np.full(theta.shape, np.inf)
    for _ in range(NEWTON_STEPS):
        residual = _theta_polynomial(theta, k) - radius
        better = np.abs(residual) < best_error
        best = np.where(better, theta, best)
        best_error = np.where(better, np.abs(residual), best_error)
        if best_error.max(initial=0.0) < 1e-10:
            break
        t2 = theta * theta
        slope = 1 + t2 * (3 * k[0] + t2 * (5 * k[1] + t2 * (7 * k[2] + t2 * 9 * k[3])))
        # A slope of 0 marks the fold of the polynomial; 1 keeps the step finite there.
        step = residual / np.where(slope > 1e-3, slope, 1.0)
        theta = np.clip(theta - np.clip(step, -0.5, 0.5), 0.0, np.pi)
    # On the axis sin(theta) / radius is 0 / 0; any factor will do as x = y = 0.
    factor = np.sin(best) / np.where(radius > 0, radius, 1.0)
    return np.concatenate([distorted * factor[..., None], np.cos(best)[..., None]], axis=-1)
