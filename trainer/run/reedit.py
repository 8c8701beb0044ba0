"""`--reedit-every K`: every K steps the editor looks at the renders as they are now, and training goes on
towards what it makes of those (the iterative dataset update of Instruct-NeRF2NeRF, Haque et al. 2023).

Renders show one scene, so what each view was given of its own is gone from them. That helps a model which
decides anew at every look, as diffusion does. It does not help a style network, which paints like pictures
alike: in style 12 on playbot's robot .25 of the change is what no scene can show, .26, .27 and .27 after one,
two and three looks, and the style doubles. The pictures lie on disk under their step: they are what a stopped
run goes on with, and the same run again paints none of them twice.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from progdf.errors import ProgdfError
from progdf.gaussians import pack
from trainer.editors import RepaintingEditor, make_editor
from trainer.options import EditorOptions, OptimizeOptions
from trainer.setup import TrainingSetup, confines_edit, quantize_image
from trainer.store.progress import RunLog
from trainer.store.run_folder import RunFolder
from trainer.views.view import crop, render_view


class Reedit:
    """New targets for the training views, every so many steps of a stage; see `pgs.Renewal`.

    Args:
        editor: paints
        setup: scene, region and the training views with their final boxes
        every: steps between two edits, counted over all stages
        confined: put back what changes outside the region
        log: of the run
    """

    def __init__(
        self, editor: RepaintingEditor, setup: TrainingSetup, every: int, confined: bool, log: RunLog
    ) -> None:
        self._editor, self._setup, self._log = editor, setup, log
        self._every, self._confined = every, confined
        self._shown = 0  # the step whose pictures are the targets now; 0: none

    def __call__(self, step: int, local: int, strength: float, offsets: Tensor) -> list[Tensor] | None:
        """See `pgs.Renewal`. A run that goes on between two edits finds the last one's pictures on disk."""
        due = step - step % self._every
        if due <= step - local or due == self._shown:
            return None
        self._shown = due
        setup, members = self._setup, self._setup.region.members
        renders: list[Tensor | None] = [None] * len(setup.train)
        if due == step:
            rows = pack(setup.scene[members], with_shN=setup.scene.sh_degree > 0) + offsets
            scene = setup.scene.replace_rows(members, rows)
            with torch.no_grad():
                renders = [
                    render_view(scene, view.camera, setup.background).clamp(0, 1) for view in setup.train
                ]
            self._log.say(f"step {step}: the editor looks at {len(renders)} renders again")
        targets = []
        for view, now in zip(setup.train, renders, strict=True):
            made = self._editor.edit_again(view, strength, now, due)
            targets.append(crop(quantize_image(view.confine(made) if self._confined else made), view.box))
        return targets


def reedit(
    options: EditorOptions,
    setup: TrainingSetup,
    optimization: OptimizeOptions,
    folder: RunFolder,
    log: RunLog,
) -> Reedit | None:
    """What --reedit-every asks for; None where it asks for nothing.

    Raises:
        ProgdfError: the editor cannot look at a picture again.
    """
    if not options.reedit_every:
        return None
    editor = make_editor(replace(options, cache=folder.painted), setup.scene, setup.region, setup.views)
    if not isinstance(editor, RepaintingEditor):
        raise ProgdfError(f"--reedit-every does not apply to {options.editor}; leave it out")
    return Reedit(editor, setup, options.reedit_every, confines_edit(editor, optimization.kind), log)
