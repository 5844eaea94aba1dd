"""Blender extension that denoises a rendered animation over time, or a still: Render > Denoise Animation.

It imports Blender's Python module ``bpy``, which is under the GPL; neither it nor mcdenoise imports the other.
"""

import queue
import tempfile
import threading
from pathlib import Path

import bpy

from . import frames


class DenoiseSettings(bpy.types.PropertyGroup):
    """Settings that are stored with a scene."""

    output: bpy.props.StringProperty(
        name="Output", subtype="DIR_PATH", description="Folder to write to; empty: `denoised` beside the rendered files"
    )
    lights: bpy.props.BoolProperty(
        name="Layers of Light",
        description="Denoise the passes of light too, such as Diffuse Direct, so that they add up to the image",
    )


def _keep_passes(settings):
    """Make files hold all passes; Blender 5 asks for the kind of the file first."""
    if hasattr(settings, "media_type"):
        settings.media_type = "MULTI_LAYER_IMAGE"
    settings.file_format = "OPEN_EXR_MULTILAYER"


class RENDER_OT_denoise_passes(bpy.types.Operator):
    """Switch on the passes that are better to denoise with, and the file format that keeps them."""

    bl_idname = "render.denoise_passes"
    bl_label = "Switch On Passes"

    def execute(self, context):
        """Tell what was switched on."""
        scene, changed = context.scene, []
        for layer in scene.view_layers:
            for owner, name, label in (
                (layer.cycles, "denoising_store_passes", "Denoising Data"),
                (layer, "use_pass_z", "Z"),
                (layer, "use_pass_vector", "Vector"),
            ):
                if layer.use and not getattr(owner, name):
                    setattr(owner, name, True)
                    changed.append(f"{label} of {layer.name}")
        if scene.render.image_settings.file_format != "OPEN_EXR_MULTILAYER":
            _keep_passes(scene.render.image_settings)
            changed.append("OpenEXR MultiLayer")
        if scene.cycles.use_denoising:
            scene.cycles.use_denoising = False
            changed.append("no denoising by Blender")
        self.report({"INFO"}, f"switched on: {', '.join(changed)}" if changed else "all passes were on")
        return {"FINISHED"}


class RENDER_OT_denoise_animation(bpy.types.Operator):
    """Denoise the rendered frames of this scene."""

    bl_idname = "render.denoise_animation"
    bl_label = "Denoise Animation"

    def invoke(self, context, event):
        """Start from the menu; the window stays usable, and Escape stops after the current frame."""
        if not self.prepare(context):
            return {"CANCELLED"}
        self.thread = threading.Thread(target=self.run, daemon=True)
        self.thread.start()
        manager = context.window_manager
        manager.progress_begin(0, len(self.files))
        self.timer = manager.event_timer_add(0.5, window=context.window)
        manager.modal_handler_add(self)
        return {"RUNNING_MODAL"}

    def modal(self, context, event):
        """Show the progress twice a second."""
        if event.type == "ESC":
            self.stopped.set()
        if event.type != "TIMER":
            return {"PASS_THROUGH"}
        count = self.done.qsize()
        if self.thread.is_alive():
            context.window_manager.progress_update(count)
            context.workspace.status_text_set(f"Denoising: {count} of {len(self.files)} frames; Esc stops")
            return {"RUNNING_MODAL"}
        context.window_manager.event_timer_remove(self.timer)
        context.window_manager.progress_end()
        context.workspace.status_text_set(None)
        return self.finish(count)

    def execute(self, context):
        """Run from a script; return when all frames are done."""
        if not self.prepare(context):
            return {"CANCELLED"}
        self.run()
        return self.finish(self.done.qsize())

    def prepare(self, context):
        """Find the files, or report why they cannot be denoised."""
        scene = context.scene
        if scene.render.image_settings.file_format != "OPEN_EXR_MULTILAYER":
            self.report({"ERROR"}, "the output is no OpenEXR MultiLayer; switch on the passes, and render")
            return False
        numbers = range(scene.frame_start, scene.frame_end + 1, scene.frame_step)
        rendered = [Path(bpy.path.abspath(scene.render.frame_path(frame=number))) for number in numbers]
        missing = [path for path in rendered if not path.is_file()]
        if missing:
            self.report({"ERROR"}, f"{missing[0]} is not there; render the animation first, or change the frame range")
            return False
        chosen = scene.denoise_animation.output
        self.output = Path(bpy.path.abspath(chosen)) if chosen else rendered[0].parent / "denoised"
        if self.output.resolve() == rendered[0].parent.resolve():
            self.report({"ERROR"}, f"{self.output} has the rendered files; choose another folder")
            return False
        self.files = [(path, self.output / path.name) for path in rendered]
        self.layer = context.view_layer.name
        self.settings = {"blurred": scene.render.use_motion_blur, "lights": scene.denoise_animation.lights}
        self.done, self.failed, self.stopped = queue.SimpleQueue(), [], threading.Event()
        return True

    def run(self):
        """Denoise the files; it touches no data of Blender, so that it may run in a thread."""
        try:
            denoise = frames.Denoiser()
            for source, target in self.files:
                if self.stopped.is_set():
                    return
                frames.denoise_frame(denoise, source, target, self.layer, **self.settings)
                self.done.put(target)
        except (frames.FrameError, OSError) as error:
            self.failed.append(str(error))

    def finish(self, count):
        """Report the result."""
        if self.failed:
            self.report({"ERROR"}, self.failed[0])
            return {"CANCELLED"}
        stopped = "stopped; " if count < len(self.files) else ""
        self.report({"WARNING" if stopped else "INFO"}, f"{stopped}{count} frames are in {self.output}")
        return {"CANCELLED" if stopped else "FINISHED"}


class IMAGE_OT_denoise_render(bpy.types.Operator):
    """Denoise the render result, and show the denoised image."""

    bl_idname = "image.denoise_render"
    bl_label = "Denoise Render Result"

    @classmethod
    def poll(cls, context):
        """Whether there is a result."""
        return "Render Result" in bpy.data.images

    def execute(self, context):
        """Save the result with its passes, denoise the file, and load it."""
        with tempfile.TemporaryDirectory() as folder:
            source, target = Path(folder) / "render.exr", Path(folder) / "denoised.exr"
            settings = context.scene.render.image_settings
            names = [name for name in ("media_type", "file_format") if hasattr(settings, name)]
            kept = [(name, getattr(settings, name)) for name in names]
            try:
                _keep_passes(settings)
                bpy.data.images["Render Result"].save_render(str(source), scene=context.scene)
                frames.denoise_frame(frames.Denoiser(), source, target, context.view_layer.name)
            except (frames.FrameError, RuntimeError) as error:
                self.report({"ERROR"}, str(error))
                return {"CANCELLED"}
            finally:
                for name, value in kept:
                    setattr(settings, name, value)
            image = bpy.data.images.load(str(target))
            image.name = "Denoised"
            image.pack()
        if context.space_data is not None and context.space_data.type == "IMAGE_EDITOR":
            context.space_data.image = image
        return {"FINISHED"}


class RENDER_PT_denoise_animation(bpy.types.Panel):
    """The panel in the Output properties."""

    bl_label = "Denoise Animation"
    bl_space_type = "PROPERTIES"
    bl_region_type = "WINDOW"
    bl_context = "output"

    def draw(self, context):
        """Draw the settings and the buttons."""
        layout, scene = self.layout, context.scene
        layout.use_property_split = True
        layout.prop(scene.denoise_animation, "output")
        layout.prop(scene.denoise_animation, "lights")
        if scene.render.use_motion_blur:
            layout.label(text="With motion blur, Blender writes no Vector: frames are denoised alone", icon="INFO")
        layout.operator(RENDER_OT_denoise_passes.bl_idname)
        layout.operator(RENDER_OT_denoise_animation.bl_idname)


def _in_render_menu(menu, context):
    menu.layout.separator()
    menu.layout.operator(RENDER_OT_denoise_animation.bl_idname)


def _in_image_menu(menu, context):
    menu.layout.operator(IMAGE_OT_denoise_render.bl_idname)


CLASSES = (
    DenoiseSettings,
    RENDER_OT_denoise_passes,
    RENDER_OT_denoise_animation,
    IMAGE_OT_denoise_render,
    RENDER_PT_denoise_animation,
)


def register():
    """Add the panel and the menu entries."""
    for kind in CLASSES:
        bpy.utils.register_class(kind)
    bpy.types.Scene.denoise_animation = bpy.props.PointerProperty(type=DenoiseSettings)
    bpy.types.TOPBAR_MT_render.append(_in_render_menu)
    bpy.types.IMAGE_MT_image.append(_in_image_menu)


def unregister():
    """Remove them again."""
    bpy.types.IMAGE_MT_image.remove(_in_image_menu)
    bpy.types.TOPBAR_MT_render.remove(_in_render_menu)
    del bpy.types.Scene.denoise_animation
    for kind in reversed(CLASSES):
        bpy.utils.unregister_class(kind)
