"""Scenes rendered by Blender's Cycles, for training on images as Blender's users have them.

Blender is optional: a separate process, with a Python that has the module ``bpy``, does the rendering.
"""

from mcdenoise.scenes.cycles.process import Blender
from mcdenoise.scenes.cycles.sequence import render_cycles
from mcdenoise.scenes.cycles.translate import Description, translate

__all__ = ["Blender", "Description", "render_cycles", "translate"]
