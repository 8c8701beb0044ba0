"""Search of the command palette by names, words, help texts and keys; and jumps in lists by letters."""

from __future__ import annotations

from collections.abc import Collection, Sequence

from .keys import TOPICS, Command, chords

WORDS = {
    "new_edit": "hue, recolor, color, colour, tint, style, prompt, layer, add layer, new layer, filter, AI, "
    "generate, texture, material, diffusion, style transfer",
    "new_grade": "grade, color grading, hue, saturation, brightness, contrast, exposure, white balance, "
    "temperature, vibrance, shadows, highlights, curve, color wheels, look, tint, clarity, sharpen, "
    "black and white, grayscale, desaturate, sepia, warm, cold, light",
    "view_settings": "background color, field of view, fov, lens, focal length, perspective, options",
    "flip_up": "upside down, straighten, horizon, wrong way up",
    "look:top": "bird's eye, plan view",
    "navigate:orbit": "rotate view, pan, turntable camera",
    "show_looks": "rename look, delete look, presets, LUT folder",
    "open": "LUT, cube, import, load, drop, recent, open recent",
    "add_scene": "merge, second, combine, import, append, add object",
    "fold": "opacity, transparency, alpha, fade, gain, layer opacity",
    "remove_selected": "erase, eraser, cut out, cut, clear, inpaint, get rid of, delete object, "
    "delete splats",
    "remove": "delete layer, trash",
    "move_selected": "rotate, scale, resize, transform, translate, gizmo, mirror, flip, place",
    "duplicate_selected": "duplicate object, paste, clone object, instance",
    "pull": "warp, liquify, deform, bend, pose, sculpt, stretch",
    "select_tool:lasso": "mask, freehand, outline",
    "select_tool:box": "rectangle, marquee, rect",
    "select_tool:flood": "magic wand, wand, bucket, connected",
    "select_tool:color": "color range, eyedropper, by color",
    "select_tool:scribble": "segment, object, quick selection, SAM, cut out object",
    "select_subject": "foreground, main object, auto mask, person",
    "isolate": "crop, trim, only this, keep only, solo selection",
    "hide_selected": "invisible",
    "hide_strays": "floaters, clean, cleanup, noise, denoise, outliers, fog, haze",
    "show_hidden": "unhide, reveal",
    "select_none": "deselect",
    "select_all": "select all",
    "select_grow": "expand selection",
    "invert": "inverse, opposite",
    "brush": "layer mask, mask brush, local, strength brush",
    "paint_tool:color": "draw, pen, pencil, paint, airbrush, brush",
    "paint_tool:clone": "heal, stamp, retouch, copy brush",
    "paint_view": "photoshop, gimp, krita, external editor, draw over",
    "decal": "sticker, logo, text, label, image, picture, poster, tattoo, watermark",
    "undo": "back, revert, mistake",
    "history": "versions, undo list",
    "reset": "zero, default, neutral",
    "solo": "alone, only this layer",
    "group": "folder",
    "before": "original, toggle edit",
    "split": "before, before and after, before after, compare, wipe, slider",
    "beside": "compare, two views, dual",
    "difference": "compare, error, heat map",
    "frame": "zoom to fit, zoom, fit, focus, center, find, look at",
    "home": "reset camera, reset view, lost",
    "fly": "walk, first person, WASD, FPS, move around",
    "next_view_mode": "render mode, display mode, shading, visualize, debug",
    "view_mode:centers": "points, point cloud, dots, positions",
    "view_mode:rings": "wireframe, ellipses, outlines, gaussians, ellipsoids",
    "view_mode:depth": "distance map, z, depth map, near far",
    "view_mode:normals": "orientation, normal map, surface direction",
    "view_mode:opacity": "transparency, alpha, opacity map",
    "view_mode:contribution": "which splats, overdraw, pixel, probe, inspect",
    "cameras": "frustum, frusta, photographs, poses, colmap, views",
    "histogram": "distribution, filter by size, select by size, levels, threshold, range, far from surface, "
    "outliers",
    "status": "stats, statistics, fps, memory, count, performance",
    "view_mode:splats": "normal view, color",
    "grid": "floor, ground",
    "measure": "ruler, distance, length, size, scale, units, tape",
    "timeline": "animate, animation, keyframes, video editor, camera path, fly through, walkthrough, "
    "slideshow",
    "key": "record",
    "safe_frame": "aspect, crop frame, letterbox, 9:16, portrait",
    "picture": "screenshot, capture, photo, snapshot picture, snip",
    "render_picture": "image, high resolution, 4K, wallpaper, transparent, export image",
    "render_film": "turntable, video, movie, mp4, gif, spin, clip, export video",
    "export": "ply, spz, download, save scene, splat file",
    "export_page": "share, publish, web, html, link, embed, upload, send",
    "save": "project, store",
    "camera": "bookmark, viewpoint, save camera",
    "snapshot": "preset, variant, remember, version",
    "keys_file": "shortcuts file, rebind keys, customize, preferences, settings",
    "help": "shortcuts, hotkeys, keyboard, manual, tutorial, controls",
    "dynamic_resolution": "performance, slow, lag, quality, speed",
    "zoom:1.1": "font size, bigger text, UI scale",
    "quit": "exit, close program",
    "panel": "hide interface, clean view, sidebar, presentation",
    "full_screen": "fullscreen, maximize",
    "reduced_motion": "accessibility, animation off",
    "demo": "example, sample, try",
}
"""Everyday words for commands, separated by commas: those of photo, video and 3D programs."""


def match(query: str, name: str, words: str = "", beside: str = "") -> int | None:
    """Return the rank of a name for a query: 0 is the best match, None means no match.

    Args:
        query: typed text
        name: name of the command
        words: everyday words for it, separated by commas
        beside: other text to search if neither matches. A query of several words also matches if each of them
            is somewhere in the three texts
    """
    needle = query.casefold().strip()
    text = name.casefold()
    known = [word.strip() for word in words.casefold().split(",")]
    everything = f"{text} {words.casefold()} {beside.casefold()}"
    letters = iter(text)
    matches = (
        text.startswith(needle),
        needle in known,
        f" {needle}" in text,
        "".join(word[0] for word in text.split()).startswith(needle),
        any(word.startswith(needle) for word in known if word),
        needle in text,
        any(needle in word for word in known),
        needle in beside.casefold(),
        all(part in everything for part in needle.split()),
        all(letter in letters for letter in needle.replace(" ", "")),  # in this order, with gaps
    )
    return next((i for i, is_match in enumerate(matches) if is_match), None)


def find_commands(query: str, offered: Collection[str]) -> list[Command]:
    """Return the commands among `offered` that match the query, the best first; all for ""."""
    found = list[tuple[int, bool, Command]]()
    for topic, commands in TOPICS.items():
        for command in commands:
            beside = f"{command.help} {topic} {' '.join(chords(command.id))}"
            rank = match(query, command.name, WORDS.get(command.id, ""), beside)
            if rank is not None and command.id in offered:
                found.append((rank, bool(command.listed), command))
    return [command for *_, command in sorted(found, key=lambda answer: answer[:2])]


def jump_to(letters: str, titles: Sequence[str], at: int) -> int | None:
    """Return the entry of a list that typed letters jump to; None for none.

    Each letter jumps to the next title that begins with it, and after the last title to the first.

    Args:
        letters: the letters typed since the last frame
        titles: entries of the list
        at: the entry with the focus; −1 for none
    """
    found = None
    for letter in letters:
        order = [(at + step) % len(titles) for step in range(1, len(titles) + 1)]
        found = next((i for i in order if titles[i].casefold().startswith(letter.casefold())), found)
        at = at if found is None else found
    return found
