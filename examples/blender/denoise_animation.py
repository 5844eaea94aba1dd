"""An add-on for Blender: denoise a rendered animation with the command line of mcdenoise, from the Render properties.

Render an animation to OpenEXR MultiLayer files with the passes Denoising Data, Z, Position and Vector switched on, then
press "Denoise Animation". The add-on runs

    mcdenoise denoise FOLDER/shot_####.exr -o FOLDER/denoised --frames START-END

in a process of its own, shows how many frames are written, and says what it said where something is wrong. The files in
the output folder have the names and layers of those rendered, with Combined denoised; load them as an image sequence.

Install this file as an add-on (Edit > Preferences > Add-ons > Install from Disk) and name the program `mcdenoise` in
its preferences. Without preferences the environment variable MCDENOISE names it, or it is looked for on PATH. It works
with Blender 4.5 and 5.0, also without a window: `bpy.ops.render.denoise_animation()` waits until all frames are done.

This file stands alone. It imports Blender's Python module ``bpy``, which is under the GPL; it imports nothing of
mcdenoise, and nothing of mcdenoise imports it.
"""

import atexit
import os
import re
import shlex
import shutil
import subprocess
import tempfile
from pathlib import Path

import bpy

bl_info = {
    "name": "Denoise Animation with mcdenoise",
    "author": "the authors of mcdenoise",
    "version": (0, 1, 0),
    "blender": (4, 5, 0),
    "location": "Properties > Render > Denoise Animation",
    "description": "Denoise rendered multilayer EXR files over time",
    "category": "Render",
}


class DenoiseAnimationPreferences(bpy.types.AddonPreferences):
    """Where the program is."""

    bl_idname = __package__ or __name__

    executable: bpy.props.StringProperty(
        name="mcdenoise", subtype="FILE_PATH", description="The program; empty: the variable MCDENOISE, then PATH"
    )

    def draw(self, context):
        """Show the setting."""
        self.layout.prop(self, "executable")


class DenoiseAnimationSettings(bpy.types.PropertyGroup):
    """What a scene remembers."""

    output: bpy.props.StringProperty(
        name="Output", subtype="DIR_PATH", description="Folder to write to; empty: `denoised` beside the rendered files"
    )
    model: bpy.props.StringProperty(name="Model", description="See `mcdenoise models`; empty: the default")
    arguments: bpy.props.StringProperty(name="Arguments", description="More arguments of `mcdenoise denoise`")


class RENDER_OT_denoise_animation(bpy.types.Operator):
    """Denoise the rendered frames of this scene."""

    bl_idname = "render.denoise_animation"
    bl_label = "Denoise Animation"

    def invoke(self, context, event):
        """From the panel: the window stays usable, Escape ends it."""
        if not self.start(context):
            return {"CANCELLED"}
        manager = context.window_manager
        manager.progress_begin(0, len(self.frames))
        self.timer = manager.event_timer_add(0.5, window=context.window)
        manager.modal_handler_add(self)
        return {"RUNNING_MODAL"}

    def modal(self, context, event):
        """Show how far the program is, twice a second."""
        if event.type == "ESC":
            self.process.terminate()
            self.process.wait()
            self.end(context)
            self.report({"WARNING"}, f"stopped; {self.written()} of {len(self.frames)} frames are in {self.output}")
            return {"CANCELLED"}
        if event.type != "TIMER":
            return {"PASS_THROUGH"}
        if self.process.poll() is None:
            context.window_manager.progress_update(self.written())
            context.workspace.status_text_set(f"Denoising: {self.written()} of {len(self.frames)} frames; Esc stops")
            return {"RUNNING_MODAL"}
        self.end(context)
        return self.finish()

    def end(self, context):
        """Take away what showed the progress."""
        context.window_manager.event_timer_remove(self.timer)
        context.window_manager.progress_end()
        context.workspace.status_text_set(None)

    def execute(self, context):
        """From a script: return when all is done."""
        if not self.start(context):
            return {"CANCELLED"}
        self.process.wait()
        return self.finish()

    def start(self, context):
        """Start the program, or report why not."""
        scene = context.scene
        settings = scene.denoise_animation
        program = find_program(context)
        if program is None:
            self.report(
                {"ERROR"}, "mcdenoise not found; name it in the add-on's preferences or in the variable MCDENOISE"
            )
            return False
        if scene.render.image_settings.file_format != "OPEN_EXR_MULTILAYER":
            self.report({"ERROR"}, "the output's file format is not OpenEXR MultiLayer; render to that first")
            return False
        numbers = range(scene.frame_start, scene.frame_end + 1, scene.frame_step)
        rendered = [Path(scene.render.frame_path(frame=number)) for number in numbers]
        missing = [path for path in rendered if not path.is_file()]
        if missing:
            self.report({"ERROR"}, f"{missing[0]} is not there; render the animation first, or change the frame range")
            return False
        folder = rendered[0].parent
        self.output = Path(bpy.path.abspath(settings.output)) if settings.output else folder / "denoised"
        self.frames = [self.output / path.name for path in rendered]
        self.before = {path: path.stat().st_mtime_ns for path in self.frames if path.is_file()}
        frames = f"{numbers[0]}-{numbers[-1]}" if scene.frame_step == 1 else ",".join(map(str, numbers))
        command = [program, "denoise", str(folder / pattern(scene)), "-o", str(self.output), "--frames", frames]
        if settings.model:
            command += ["--model", settings.model]
        command += shlex.split(settings.arguments)
        # Files instead of pipes, because nothing reads them while the program runs.
        self.said, self.complained = (tempfile.TemporaryFile() for _ in range(2))  # noqa: SIM115 (closed when read)
        try:
            self.process = subprocess.Popen(command, stdout=self.said, stderr=self.complained, stdin=subprocess.DEVNULL)
        except OSError as error:
            self.report({"ERROR"}, f"{program} cannot be run ({error.strerror}); name mcdenoise in the preferences")
            return False
        return True

    def written(self):
        """How many frames are there that were not there before."""
        return sum(path.is_file() and path.stat().st_mtime_ns != self.before.get(path) for path in self.frames)

    def finish(self):
        """Report how it ended."""
        said, complained = last_lines(self.said), last_lines(self.complained)
        for line in complained:
            if line.startswith("warning:"):
                self.report({"WARNING"}, line.removeprefix("warning: "))
        if self.process.returncode:
            why = complained[-1] if complained else f"mcdenoise ended with code {self.process.returncode}"
            self.report({"ERROR"}, why)
            return {"CANCELLED"}
        self.report({"INFO"}, said[-1] if said else f"{len(self.frames)} frames in {self.output}")
        return {"FINISHED"}


class RENDER_PT_denoise_animation(bpy.types.Panel):
    """The panel in the Render properties."""

    bl_label = "Denoise Animation"
    bl_space_type = "PROPERTIES"
    bl_region_type = "WINDOW"
    bl_context = "render"
    bl_options = {"DEFAULT_CLOSED"}  # noqa: RUF012 (Blender reads it from the class)

    def draw(self, context):
        """Show the settings, what would help, and the button."""
        layout, scene = self.layout, context.scene
        layout.use_property_split = True
        for name in ("output", "model", "arguments"):
            layout.prop(scene.denoise_animation, name)
        for hint in hints(scene):
            layout.label(text=hint, icon="INFO")
        layout.operator(RENDER_OT_denoise_animation.bl_idname)


def find_program(context):
    """The program's path: from the preferences, the environment or PATH; None where it is nowhere."""
    addon = context.preferences.addons.get(__package__ or __name__)
    named = (addon and addon.preferences and addon.preferences.executable) or os.environ.get("MCDENOISE")
    return bpy.path.abspath(named) if named else shutil.which("mcdenoise")


def pattern(scene):
    """The name of the rendered files with ``#`` in place of the frame's number."""
    # Blender pads to as many digits as the last run of # in the file's name has, and to four where there is none.
    runs = re.findall("#+", re.split(r"[/\\]", scene.render.filepath)[-1])
    digits = len(runs[-1]) if runs else 4
    names = [Path(scene.render.frame_path(frame=int(digit * digits))).name for digit in "12"]
    return "".join("#" if one != other else one for one, other in zip(*names, strict=True))


def hints(scene):
    """What would make the result better."""
    layers = [layer for layer in scene.view_layers if layer.use]
    if not all(layer.cycles.denoising_store_passes for layer in layers):
        yield "Switch on the pass Denoising Data"
    if not all(layer.use_pass_vector for layer in layers) or scene.render.use_motion_blur:
        yield "Without Vector (or with motion blur) the motion is found from Position"
    if not all(layer.use_pass_position for layer in layers):
        yield "Switch on the pass Position"


def last_lines(file):
    """The lines that a program wrote, without empty ones."""
    with file:
        file.seek(0)
        return [line for line in file.read().decode(errors="replace").splitlines() if line.strip()]


CLASSES = (
    DenoiseAnimationPreferences,
    DenoiseAnimationSettings,
    RENDER_OT_denoise_animation,
    RENDER_PT_denoise_animation,
)


def register():
    for kind in CLASSES:
        bpy.utils.register_class(kind)
    bpy.types.Scene.denoise_animation = bpy.props.PointerProperty(type=DenoiseAnimationSettings)
    if bpy.app.module:
        # As a Python module, Blender 4.5 never ends while a panel or an operator is registered.
        atexit.register(unregister)


def unregister():
    atexit.unregister(unregister)
    del bpy.types.Scene.denoise_animation
    for kind in reversed(CLASSES):
        bpy.utils.unregister_class(kind)


if __name__ == "__main__":
    register()
