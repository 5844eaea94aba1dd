"""Rendering with Mitsuba 3: from a scene and a camera path to a noisy sequence with features and references."""

from mcdenoise.data.camera_path import Camera, CameraPath, load_camera_path, view_projection
from mcdenoise.scenes.render.film import FILTERS, Film
from mcdenoise.scenes.render.loading import VARIANTS, Scene, choose_variant
from mcdenoise.scenes.render.sequence import render_sequence

__all__ = [
    "FILTERS",
    "VARIANTS",
    "Camera",
    "CameraPath",
    "Film",
    "Scene",
    "choose_variant",
    "load_camera_path",
    "render_sequence",
    "view_projection",
]
