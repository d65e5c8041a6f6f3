"""Models of depth sensors and of a colour camera.

The default `DepthSensor` is a Kinect v1 or Xtion. It shifts pixels on depth edges sideways, in small patches.
Disparity has Gaussian noise and is rounded to eighths of a Kinect pixel (f = 525 pixels, baseline 75 mm). Noise and
rounding give depth a standard deviation of 1.85 mm (z / m)^2, as measured on real table tops. There is no reading in
the shadow of the projector (to the left of objects), at some depth edges, on surfaces at a grazing angle, and out of
range.

`SENSORS` has models of further cameras, as a `DepthSensor` with other fields. The disparity d = f b / z of a stereo
camera has errors of a part of a pixel, so depth has a standard deviation of z^2 / (f b) times this part. A camera
that measures time of flight has no baseline: errors grow with the distance and with the darkness of the surface, and
pixels at depth edges read distances between both surfaces (flying pixels). Dark surfaces reflect too little light to
be read, and surfaces like mirrors too much. Errors that depend on the whole scene, such as light that is reflected
twice, are not modelled. Sources of the constants:

- Xtion: 45 real frames; Khoshelham and Elberink, "Accuracy and resolution of Kinect depth data for indoor mapping
  applications", Sensors 12(2), 2012 (baseline, eighths of a pixel).
- D415, D435: Intel RealSense D400 series datasheet (baselines 55 and 50 mm, horizontal fields of view 65 and 87
  degrees at 1280 and 848 pixels, nearest distance 0.45 m of the D415 at 1280 pixels). Intel's A. Grunnet-Jepsen in
  IntelRealSense/librealsense, issues 3904 (errors of disparity of 0.08 pixels in practice and 0.032 at best) and 999
  (nearest distance 0.17 m of the D435 at 848 pixels; 0.28 m is that at 1280 pixels). Disparity has 5 bits below a
  pixel: Keselman, Woodfill, Grunnet-Jepsen and Bhowmik, "Intel RealSense stereoscopic depth cameras", CVPR
  Workshops, 2017, of their predecessor.
- Azure Kinect: Microsoft's hardware specification (narrow field of view: 0.5 to 3.86 m, standard deviation at most
  17 mm); Tölgyessy, Dekan, Chovanec and Hubinský, "Evaluation of the Azure Kinect and its comparison to Kinect v1 and
  Kinect v2", Sensors 21(2), 2021, confirms this bound and describes flying pixels and dark materials. The focal
  length is that of factory calibrations (0.49 of 1024 pixels; microsoft/Azure-Kinect-Sensor-SDK, issue 1617).
- L515: Intel RealSense LiDAR camera L515 datasheet, revision 003 (field of view 70 degrees, 0.25 to 9 m, standard
  deviation 2.5 mm at 1 m and 15.5 mm at 9 m on a surface that reflects 95 % of the light; ours is 22.5 mm at 9 m).

Shares of lost and flying pixels, the darkest surface and the standard deviation of the Azure Kinect at 1 m are
assumptions, except for the Xtion; only the L515 loses the black ink of prints. The correlation of stereo noise is
that of a matching window of about 7 pixels.

The colour camera has optical blur, photon noise and the sRGB curve.

>>> import numpy as np
>>> from mstfilter.lab.simulation.sensor import DepthSensor
>>> flat = np.full((40, 60), 0.8, np.float32)
>>> noisy = DepthSensor().read(np.random.default_rng(0), flat, np.ones_like(flat))
>>> bool(abs(np.nanmean(noisy) - 0.8) < 0.001)
True
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated

import numpy as np

from mstfilter.base.fields import Bounded, Bounds, NonNegativeFloat, PositiveFloat, Share

_EDGE_STEP = 0.02  # relative difference of depth between neighbours from which they form an edge
_PATCH = 3  # side of the square of pixels of the raster that are shifted or lost together

_BLUR = 0.45  # standard deviation of the blur of the colour camera's optics, pixels
_PHOTON_NOISE = 0.010  # standard deviation at white, as a share of white; proportional to the root of the light
_READ_NOISE = 0.002  # standard deviation in the dark, as a share of white

#: Pairs of views of an image that hold vertical and horizontal neighbours.
NEIGHBOURS = ((np.s_[1:], np.s_[:-1]), (np.s_[:, 1:], np.s_[:, :-1]))


@dataclass(frozen=True)
class DepthSensor(Bounded):
    """Errors and missing readings of a depth camera. The defaults are those of a Kinect v1 or Xtion.

    Pixels are those of a raster of 640 pixels per row; other images are scaled from it.

    Parameters
    ----------
    lateral : float
        Standard deviation of the sideways shift on depth edges, pixels.
    edge_dropout : float
        Probability that a patch of pixels within two pixels of a depth edge has no reading. `edge_dropout` and `fill`
        were fitted to the frequencies of missing readings 1 .. 10 pixels beside objects in 45 real frames.
    fill : float
        Width by which the sensor narrows the shadow beside objects, pixels.
    focal : float
        Focal length, pixels.
    baseline : float
        Distance of the projector or second camera, metres. 0 is a camera that measures time of flight.
    quantum, noise : float
        Step of the disparity, and standard deviation of the disparity before it is rounded, pixels.
    correlation : float
        Standard deviation of the blur that makes the noise of neighbouring pixels alike, pixels. 0 is independent
        noise.
    axial : float
        Of time of flight: standard deviation of the distance at 1 m on a white surface, metres. It grows with the
        distance and with the inverse root of the reflected share of light.
    flying : float
        Probability that a pixel beside a depth edge reads a distance between both surfaces.
    darkest : float
        Share of light below which a surface 1 m away has no reading. The limit grows with the square of the distance.
    shiny : float
        Probability that a patch of pixels on a glossy surface that mirrors the camera has no reading.
    grazing : float
        Angle of incidence beyond which there is no reading, radians.
    nearest, farthest : float
        Range, metres.
    """

    lateral: NonNegativeFloat = 0.5
    edge_dropout: Share = 0.12
    fill: NonNegativeFloat = 2.5
    focal: PositiveFloat = 525.0
    baseline: NonNegativeFloat = 0.075
    quantum: PositiveFloat = 0.125
    noise: NonNegativeFloat = 0.0625
    correlation: NonNegativeFloat = 0.0
    axial: NonNegativeFloat = 0.0
    flying: Share = 0.0
    darkest: Share = 0.0
    shiny: Share = 0.0
    grazing: Annotated[float, Bounds(above=0, at_most=1.5707963267948966)] = 1.4
    nearest: NonNegativeFloat = 0.4
    farthest: PositiveFloat = 4.0

    @property
    def sees_materials(self) -> bool:
        """Whether readings depend on the reflectance and gloss of surfaces."""
        return self.darkest > 0 or self.shiny > 0 or self.baseline == 0

    def read(
        self,
        rng: np.random.Generator,
        depth: np.ndarray,
        slant: np.ndarray,
        reflectance: np.ndarray | None = None,
        shine: np.ndarray | None = None,
    ) -> np.ndarray:
        """Depth image (H, W) float32 in metres, NaN for no reading.

        `depth` (H, W) is the true z-depth in metres, with NaN for no surface. `slant` (H, W) is the cosine of
        incidence. `reflectance` (H, W) is the share of light that a surface reflects (default: white), and `shine`
        (H, W) the strength of its mirror image of the camera, 0 .. 1 (default: none).
        """
        h, w = depth.shape
        edge = _depth_edges(depth)
        # The sideways shift frays edges; within a surface it is part of the axial noise, which was measured on tilted
        # tables.
        scale = w / 640.0
        side = max(1, round(_PATCH * scale))
        aside = self.lateral * scale * edge
        rows = np.arange(h)[:, None] + np.rint(_patches(rng.standard_normal, h, w, side) * aside).astype(np.int64)
        columns = np.arange(w)[None, :] + np.rint(_patches(rng.standard_normal, h, w, side) * aside).astype(np.int64)
        at = np.clip(rows, 0, h - 1), np.clip(columns, 0, w - 1)
        z, cosine = depth[at], slant[at]
        light = np.ones_like(cosine) if reflectance is None else np.clip(reflectance[at], 0.01, 1.0) * cosine
        noise = self._blurred(rng.standard_normal((h, w)), scale)
        if self.baseline:
            steps = self.focal * self.baseline / self.quantum  # of the disparity at one metre
            noise = noise * (self.noise / self.quantum)
            with np.errstate(invalid="ignore", divide="ignore"):
                reading = steps / np.maximum(np.rint(steps / z + noise), 1.0)
        else:
            reading = z + noise * self.axial * z / np.sqrt(np.maximum(light, 0.02))
        wide = edge.copy()
        for axis in (0, 1):
            wide |= np.roll(edge, 1, axis) | np.roll(edge, -1, axis)
        lost = wide & (_patches(rng.uniform, h, w, side) < self.edge_dropout)
        lost |= self._unlit(depth)[at]
        lost |= (cosine < np.cos(self.grazing)) | (reading < self.nearest) | (reading > self.farthest)
        if self.flying:
            reading = np.where(edge & (rng.uniform(size=(h, w)) < self.flying), _between(rng, depth), reading)
        if self.darkest:
            with np.errstate(invalid="ignore"):
                lost |= light < self.darkest * z**2 * rng.uniform(0.7, 1.3, (h, w))
        if self.shiny and shine is not None:
            lost |= _patches(rng.uniform, h, w, side) < self.shiny * shine[at]
        return np.where(lost | ~np.isfinite(z), np.nan, reading).astype(np.float32)

    def _blurred(self, noise: np.ndarray, scale: float) -> np.ndarray:
        """Noise of standard deviation 1 whose neighbouring pixels are alike."""
        width = self.correlation * scale
        if width < 0.3:
            return noise
        from scipy.ndimage import gaussian_filter

        blurred = gaussian_filter(noise, width)
        return np.asarray(blurred / blurred.std())

    def _unlit(self, depth: np.ndarray) -> np.ndarray:
        """Pixels (H, W) bool that the projector does not illuminate. The projector is to the right of the camera.

        A pixel in column u with depth z is in column u - f b / z of the projector's image. A pixel is in shadow if
        a pixel to its right in the camera's image is to its left in the projector's image.
        """
        w = depth.shape[1]
        disparity = self.focal * w / 640.0 * self.baseline / np.where(np.isfinite(depth), depth, np.inf)
        there = np.arange(w) - disparity
        least = np.minimum.accumulate(there[:, ::-1], axis=1)[:, ::-1]
        return there > least + self.fill * w / 640.0


#: Depth cameras by name. Disparities in pixels of the depth image (1280 pixels per row for the D415, 848 for the
#: D435) are converted to pixels of images of 640 pixels with the focal length of the colour image.
SENSORS: dict[str, DepthSensor] = {
    "xtion": DepthSensor(),
    "d415": DepthSensor(
        lateral=0.8, edge_dropout=0.25, fill=1.0, focal=615.0, baseline=0.055, quantum=0.019, noise=0.049,
        correlation=1.5, flying=0.10, darkest=0.006, shiny=0.3, grazing=1.45, nearest=0.45, farthest=10.0,
    ),
    "d435": DepthSensor(
        lateral=1.2, edge_dropout=0.25, fill=1.0, focal=615.0, baseline=0.050, quantum=0.043, noise=0.110,
        correlation=2.5, flying=0.15, darkest=0.006, shiny=0.3, grazing=1.45, nearest=0.17, farthest=10.0,
    ),
    "azure": DepthSensor(
        lateral=0.3, edge_dropout=0.30, fill=0.0, focal=505.0, baseline=0.0, axial=0.0015, flying=0.35,
        darkest=0.012, shiny=0.5, grazing=1.4, nearest=0.5, farthest=3.86,
    ),
    "l515": DepthSensor(
        lateral=0.3, edge_dropout=0.20, fill=0.0, focal=600.0, baseline=0.0, axial=0.0025, flying=0.20,
        darkest=0.05, shiny=0.8, grazing=1.35, nearest=0.25, farthest=9.0,
    ),
}  # fmt: skip


def _between(rng: np.random.Generator, depth: np.ndarray) -> np.ndarray:
    """Distances between the nearest and the farthest surface in the 3 x 3 pixels around a pixel."""
    from scipy.ndimage import maximum_filter, minimum_filter

    near = minimum_filter(np.where(np.isfinite(depth), depth, np.inf), 3)
    far = maximum_filter(np.where(np.isfinite(depth), depth, -np.inf), 3)
    with np.errstate(invalid="ignore"):
        return near + rng.uniform(size=depth.shape) * (far - near)


def _depth_edges(depth: np.ndarray) -> np.ndarray:
    """Pixels (H, W) bool on either side of a step in depth."""
    edge = np.zeros(depth.shape, bool)
    for here, there in NEIGHBOURS:
        first, second = depth[here], depth[there]
        with np.errstate(invalid="ignore"):
            step = ~(np.abs(first - second) <= _EDGE_STEP * np.minimum(first, second))
        step &= np.isfinite(first) | np.isfinite(second)
        edge[here] |= step
        edge[there] |= step
    return edge


def _patches(draw: Callable[..., np.ndarray], h: int, w: int, side: int) -> np.ndarray:
    """Random values (h, w) that are constant within squares of side x side pixels."""
    small = draw(size=(-(-h // side), -(-w // side)))
    return np.repeat(np.repeat(small, side, axis=0), side, axis=1)[:h, :w]


def colour_reading(rng: np.random.Generator, linear: np.ndarray) -> np.ndarray:
    """sRGB image (H, W, 3) uint8 of a colour camera from exposed linear light (H, W, 3), in which 1 is white."""
    import cv2

    light = np.maximum(cv2.GaussianBlur(linear, (0, 0), _BLUR), 0.0)
    # Compress highlights instead of clipping them, as cameras do.
    light = np.where(light > 0.7, 0.7 + 0.3 * np.tanh((light - 0.7) / 0.3), light)
    noise = rng.standard_normal(light.shape, dtype=np.float32)
    light = light + noise * np.sqrt(_PHOTON_NOISE**2 * light + _READ_NOISE**2)
    return _DISPLAY[np.clip(light * 4095.0 + 0.5, 0, 4095).astype(np.int64)]


def _display_curve() -> np.ndarray:
    light = np.arange(4096) / 4095.0
    value = np.where(light <= 0.0031308, 12.92 * light, 1.055 * np.maximum(light, 1e-9) ** (1 / 2.4) - 0.055)
    return np.clip(np.rint(255.0 * value), 0, 255).astype(np.uint8)


_DISPLAY = _display_curve()
