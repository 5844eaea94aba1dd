"""Scenes rendered by Blender's Cycles, for training on images as Blender's users have them.

Blender is optional: a separate process, with a Python that has the module ``bpy``, does the rendering.
"""

from mcdenoise.scenes.cycles.process import Blender
from mcdenoise.scenes.cycles.sequence import render_cycles

__all__ = ["Blender", "render_cycles"]
