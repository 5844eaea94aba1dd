"""Rendering with Mitsuba 3: from a scene and a camera path to a noisy sequence with features and references."""

from mcdenoise.data.camera_path import Camera, Shot, load_shot, view_projection
from mcdenoise.scenes.render.film import FILTERS, Film
from mcdenoise.scenes.render.sequence import render_sequence
from mcdenoise.scenes.render.tracer import VARIANTS, Scene, choose_variant

__all__ = [
    "FILTERS",
    "VARIANTS",
    "Camera",
    "Film",
    "Scene",
    "Shot",
    "choose_variant",
    "load_shot",
    "render_sequence",
    "view_projection",
]
