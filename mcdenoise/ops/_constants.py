"""Numbers that the reference of an op and its fast backends share; compiled kernels have them built in."""

from __future__ import annotations

import math

# Reflectance of a smooth dielectric at normal incidence: on a darker surface most of the light is gloss, which no
# albedo tints, and dividing it by a smaller number would give sparse, coloured, huge values.
FLOOR = 4e-2
# Below this there is no texture: less than half of the darkest 8-bit sRGB step above black.
NO_ALBEDO = 1e-4

# How far a tap's point may lie off the tangent plane, and (without positions) how far its depth may differ, both as
# fractions of the depth.
PLANE_LIMIT = 0.02
DEPTH_LIMIT = 0.1
# Largest |difference|^2 of two unit normals: 0.5 allows an angle of 41 degrees.
NORMAL_LIMIT_SQUARED = 0.5
# Taps of a pixel's own label are enough from this weight on; a tap in the pixel itself, which stands still, weighs 1.
LABEL_WEIGHT = 1e-3

# Parameter of Keys' bicubic kernel, its slope at a distance of 1; that of torch. Catmull-Rom splines have -0.5.
CUBIC = -0.75

# Smallest lag as a fraction of the local mean: a difference that no eye sees is no lag, however little noise there is.
SMALLEST_LAG = 1e-3
# Side of the window of means that are compared, in pixels.
LAG_WINDOW = 5
# For a second, shorter history: the smallest weight of a frame, so that four frames have half the noise of one; and how
# many equally weighted frames have its noise once it is full, (2 - alpha) / alpha.
RECENT_ALPHA, RECENT_FRAMES = 0.25, 7
# Side of the blocks, 3x3 of which tell how much the light has changed; the squared standard errors up to which that is
# noise, twice those of a lag because neighbouring pixels share noise; and the factors of a root that are possible.
RELIT_BLOCK, RELIT_DOUBT, RELIT = 16, 8.0, (0.7, 1.4)
# Largest motion, in pixels, that counts as standing still.
STILL = 0.05
# A light that is seen: how far the compressed radiance of 3x3 pixels may differ, and how bright they are beside the
# mean of a window. Fewer pixels are often alike by chance where one of a few lights is drawn for each, and some of the
# light is lost to that.
EVEN, BRIGHTER, LIGHT_WINDOW = 0.03, 1.2, 9

# The epsilon of SVGF's Eq. 3, which the paper leaves open, as a fraction of the depth: the precision of depths in half
# floats. The others keep quotients and their derivatives finite, where `exp` of them is zero in any precision.
DEPTH_EPSILON, LEAST_DEPTH, HIGHEST_QUOTIENT = 1e-3, 1e-30, 1e4

# Smallest weight of a pixel in its own mean: where it is like none of its neighbours it stays as it is, and nothing is
# divided by 0. Larger differences of features than the second number count as that number, so that no square overflows.
LEAST_CENTER, FARTHEST_FEATURE = 1e-6, 1e15

# A guide in [0, 1] is a value from 0 to 255, whose 256 steps are divided among the bins of a grid. The tents use
# sqrt(x^2 + TENT_ROUNDING) for |x|, which has a derivative at 0.
GUIDE_STEPS, TENT_ROUNDING = 256, 1e-8

# Side of the blocks of pixels for which `wild` weighs its history.
BLOCK = 4

# Open Image Denoise's perceptually uniform scale: `a y` in the dark, `b y^c + d` in the middle, `e log(y + f) + g` for
# bright radiance. The joints are radiance (y0, y1), and places on the scale (x0, x1) before it is divided by its value
# at the largest half-precision number, to which brighter radiance is clamped.
PU_DARK = 1.41283765e03
PU_MIDDLE = (1.64593172e00, 4.31384981e-01, -2.94139609e-03)
PU_BRIGHT = (1.92653254e-01, 6.26026094e-03, 9.98620152e-01)
PU_JOINTS = (1.57945760e-06, 3.22087631e-02, 2.23151711e-03, 3.70974749e-01)
MAX_RADIANCE = 65504.0
PU_WHITE = PU_BRIGHT[0] * math.log(MAX_RADIANCE + PU_BRIGHT[1]) + PU_BRIGHT[2]
