"""Denoises Cycles renders with `demc-infer`: a panel in the render properties, and operators.

`bpy.ops.demc` works without a window, too:

    set_passes()                                 passes, pixel filter, and file format that demc-infer needs
    denoise_file(filepath=..., output=...)       denoises a multilayer EXR file
    denoise_render(), render_and_denoise()       denoise the last render, or render and denoise
    set_reference(samples=512)                   settings for a training reference of the same view
"""

from __future__ import annotations

import os

import bpy
from bpy.props import BoolProperty, IntProperty, StringProperty

from .program import Failure, Job

POLL_SECONDS = 0.2


class DemcPreferences(bpy.types.AddonPreferences):
    """Paths. They are the user's, not the file's: a .blend file cannot choose what program runs."""

    bl_idname = __package__

    program: StringProperty(
        name="Program", description="Path of demc-infer. If empty, it is searched on the PATH", subtype="FILE_PATH"
    )
    model: StringProperty(
        name="Model", description="Bundled model (quality or fast), exported model, or run directory. If empty: quality", subtype="FILE_PATH"
    )

    def draw(self, context):
        self.layout.prop(self, "program")
        self.layout.prop(self, "model")


def preferences():
    return bpy.context.preferences.addons[__package__].preferences


class ForCycles:
    """Only Cycles writes the passes that demc-infer needs."""

    @classmethod
    def poll(cls, context):
        cls.poll_message_set("The render engine is not Cycles.")
        return context.scene.render.engine == "CYCLES"


class DEMC_OT_set_passes(ForCycles, bpy.types.Operator):
    """Switches on the passes, sets pixel filter and output format, and switches off Cycles' denoiser"""

    bl_idname = "demc.set_passes"
    bl_label = "Set Passes"
    bl_options = {"REGISTER", "UNDO"}

    def execute(self, context):
        scene = context.scene
        for layer in scene.view_layers:
            layer.use_pass_combined = True
            layer.use_pass_normal = True
            layer.use_pass_position = True
            layer.cycles.denoising_store_passes = True
        set_output(scene, "MULTI_LAYER_IMAGE", "OPEN_EXR_MULTILAYER")
        return {"FINISHED"}


class DEMC_OT_set_reference(ForCycles, bpy.types.Operator):
    """Sets samples, another seed, pixel filter, and a plain EXR output for a training reference"""

    bl_idname = "demc.set_reference"
    bl_label = "Set Reference"
    bl_options = {"REGISTER", "UNDO"}

    samples: IntProperty(name="Samples", description="Samples per pixel", default=512, min=1)

    def execute(self, context):
        cycles = context.scene.cycles
        cycles.samples = self.samples
        cycles.use_adaptive_sampling = False
        cycles.seed = (cycles.seed + 1) % 2**31
        set_output(context.scene, "IMAGE", "OPEN_EXR")
        return {"FINISHED"}


def set_output(scene, media_type, file_format):
    """A 32-bit EXR file, the pixel filter of the training images, and no denoiser of Cycles."""
    scene.cycles.use_denoising = False
    scene.cycles.pixel_filter_type = "BOX"
    image = scene.render.image_settings
    # Since Blender 5.0, the formats depend on the media type.
    if hasattr(image, "media_type"):
        image.media_type = media_type
    image.file_format = file_format
    image.color_depth = "32"
    image.exr_codec = "ZIP"


class Denoising:
    """Runs the program: in the background for a button, until its end for a script."""

    job = timer = None

    def begin(self, context, source, target, layer, wait):
        """Starts the program. With `wait`, also ends the work."""
        source, target = bpy.path.abspath(source), bpy.path.abspath(target)
        chosen = preferences()
        model = bpy.path.abspath(chosen.model) if chosen.model else ""
        program = bpy.path.abspath(chosen.program) if chosen.program else ""
        if not os.path.exists(source):
            return self.fail(f"There is no file {source}.")
        if model and not os.path.exists(model):
            return self.fail(f"There is no model {model}.")
        try:
            self.job = Job(program, source, target, model, layer)
        except Failure as failure:
            return self.fail(str(failure))
        if wait:
            return self.end(context)
        self.timer = context.window_manager.event_timer_add(POLL_SECONDS, window=context.window)
        context.window_manager.modal_handler_add(self)
        context.workspace.status_text_set("demc-infer denoises the image. Esc: cancel")
        return {"RUNNING_MODAL"}

    def modal(self, context, event):
        if event.type == "ESC":
            self.job.stop()
            self.leave(context)
            self.report({"INFO"}, "Denoising was cancelled.")
            return {"CANCELLED"}
        if event.type == "TIMER" and not self.job.running():
            self.leave(context)
            return self.end(context)
        return {"PASS_THROUGH"}

    def leave(self, context):
        context.window_manager.event_timer_remove(self.timer)
        context.workspace.status_text_set(None)

    def end(self, context):
        try:
            warnings = self.job.finish()
        except Failure as failure:
            return self.fail(str(failure))
        for warning in warnings:
            self.report({"WARNING"}, warning)
        show(context, self.job.target)
        self.report({"INFO"}, f"The denoised image is {self.job.target}.")
        return {"FINISHED"}

    def fail(self, sentence):
        self.report({"ERROR"}, sentence)
        return {"CANCELLED"}


def show(context, path):
    """Loads an image, or loads it again, and shows it in the first image editor."""
    image = bpy.data.images.load(path, check_existing=True)
    image.reload()
    for area in context.screen.areas if context.screen else ():
        if area.type == "IMAGE_EDITOR":
            area.spaces.active.image = image
            break


def denoised_name(path):
    stem, extension = os.path.splitext(path)
    return f"{stem}-denoised{extension}"


class DEMC_OT_denoise_file(Denoising, bpy.types.Operator):
    """Denoises a multilayer EXR file. All other passes stay as they are"""

    bl_idname = "demc.denoise_file"
    bl_label = "Denoise File"

    filepath: StringProperty(name="File", subtype="FILE_PATH")
    filter_glob: StringProperty(default="*.exr", options={"HIDDEN"})
    output: StringProperty(
        name="Output", description="Path of the denoised file. If empty, NAME-denoised.exr beside the file", subtype="FILE_PATH"
    )
    layer: StringProperty(name="View Layer", description="Needed for files with several view layers")
    wait: BoolProperty(name="Wait", default=True, options={"HIDDEN"})

    def invoke(self, context, event):
        self.wait = False
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    def execute(self, context):
        return self.begin(context, self.filepath, self.output or denoised_name(self.filepath), self.layer, self.wait)


class DenoisingRender(Denoising, ForCycles):
    """What follows a render. A registered operator cannot be the parent of another."""

    def save_and_begin(self, context, wait):
        scene = context.scene
        if scene.render.image_settings.file_format != "OPEN_EXR_MULTILAYER":
            return self.fail("The output is no multilayer EXR file: press Set Passes and render again.")
        path = bpy.path.ensure_ext(bpy.path.abspath(scene.render.frame_path(frame=scene.frame_current)), ".exr")
        try:
            os.makedirs(os.path.dirname(path), exist_ok=True)
            bpy.data.images["Render Result"].save_render(path, scene=scene)
        except KeyError:
            return self.fail("There is no render yet.")
        except (OSError, RuntimeError) as error:
            return self.fail(f"The render cannot be saved to {path}: {str(error).strip().rstrip('.')}.")
        several = sum(layer.use for layer in scene.view_layers) > 1
        return self.begin(context, path, denoised_name(path), context.view_layer.name if several else "", wait)


class DEMC_OT_denoise_render(DenoisingRender, bpy.types.Operator):
    """Saves the last render to the output path, denoises the active view layer, and loads the result"""

    bl_idname = "demc.denoise_render"
    bl_label = "Denoise Last Render"

    def invoke(self, context, event):
        return self.save_and_begin(context, wait=False)

    def execute(self, context):
        return self.save_and_begin(context, wait=True)


class DEMC_OT_render_and_denoise(DenoisingRender, bpy.types.Operator):
    """Renders the current frame and denoises it. Blender does not respond while it renders"""

    bl_idname = "demc.render_and_denoise"
    bl_label = "Render and Denoise"

    def invoke(self, context, event):
        return self.render_and_begin(context, wait=False)

    def execute(self, context):
        return self.render_and_begin(context, wait=True)

    def render_and_begin(self, context, wait):
        bpy.ops.render.render(scene=context.scene.name)
        return self.save_and_begin(context, wait)


class DEMC_PT_panel(bpy.types.Panel):
    """The panel in the render properties."""

    bl_label = "DEMC Denoiser"
    bl_idname = "DEMC_PT_panel"
    bl_space_type = "PROPERTIES"
    bl_region_type = "WINDOW"
    bl_context = "render"

    @classmethod
    def poll(cls, context):
        return context.scene.render.engine == "CYCLES"

    def draw(self, context):
        column = self.layout.column()
        column.use_property_split = True
        column.prop(preferences(), "program")
        column.prop(preferences(), "model")
        column.operator(DEMC_OT_set_passes.bl_idname)
        column.operator(DEMC_OT_render_and_denoise.bl_idname)
        column.operator(DEMC_OT_denoise_render.bl_idname)
        column.operator(DEMC_OT_denoise_file.bl_idname)


CLASSES = (
    DemcPreferences,
    DEMC_OT_set_passes,
    DEMC_OT_set_reference,
    DEMC_OT_denoise_file,
    DEMC_OT_denoise_render,
    DEMC_OT_render_and_denoise,
    DEMC_PT_panel,
)


def register():
    for cls in CLASSES:
        bpy.utils.register_class(cls)


def unregister():
    for cls in reversed(CLASSES):
        bpy.utils.unregister_class(cls)
