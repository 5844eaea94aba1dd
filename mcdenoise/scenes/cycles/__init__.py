"""Random scenes rendered by Blender's Cycles, to train on what Blender's users have.

Blender is optional: another Python that has its module ``bpy`` renders, in a process of its own.
"""

from mcdenoise.scenes.cycles.process import Blender
from mcdenoise.scenes.cycles.sequence import render_cycles
from mcdenoise.scenes.cycles.settings import CyclesSettings, draw_settings
from mcdenoise.scenes.cycles.translate import Description, translate

__all__ = ["Blender", "CyclesSettings", "Description", "draw_settings", "render_cycles", "translate"]
