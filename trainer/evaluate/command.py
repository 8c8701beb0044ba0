"""The command `progdf evaluate`: figures of a finished run in one table and one picture."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from PIL import Image
from torch import Tensor

from progdf.errors import ProgdfError
from progdf.io.images import contact_sheet, to_picture, write_image
from progdf.terminal import print_line
from trainer.optimize.losses import Perceptual, perceptual_loss
from trainer.options import EvaluateOptions
from trainer.report.plots import PAPER, Plot
from trainer.report.report import (
    best_view,
    column_heading,
    columns_of,
    editor_strip,
    even,
    middles,
    stack_plots,
    thumbnail,
    view_caption,
)
from trainer.resolve import prepare_process
from trainer.run.finish import effective_texts
from trainer.store.run_folder import write_json

from .consistency import EDITED, UNEDITED, WarpedPair
from .measures import Evaluation, evaluate_run, evaluation_json, evaluation_table, summary_table
from .opened import OpenedRun, open_run

_THUMBNAIL_WIDTH = 240  # pixels
_DIFFERENCE_GAIN = 4  # factor of the difference pictures
_SPAN = (0.0, 1.0)  # range of the slider axis


def evaluation_picture(opened: OpenedRun, evaluation: Evaluation) -> Tensor:
    """Draw thumbnails above curves. -> [H,W,3]"""
    evaluator = opened.evaluator
    columns = columns_of(opened.trajectory.stage_strengths)
    best = best_view(evaluator)
    strips = {
        name: [thumbnail(pictures(s)[best], _THUMBNAIL_WIDTH) for s, _ in columns]
        for name, pictures in opened.contenders().items()
    }
    strips["the editor"] = editor_strip(evaluator, columns, _THUMBNAIL_WIDTH)
    sheets = [
        contact_sheet(
            list(strips.values()),
            list(strips),
            [column_heading(*column) for column in columns],
            f"{opened.gdf.name}: {opened.run.record.plan.editor.editor}",
            view_caption(evaluator, len(opened.setup.held_out)),
        )
    ]
    pairs = evaluation.consistency.pairs
    if pairs:
        sheets.append(_warp_sheet(max(pairs, key=lambda pair: pair.shared)))
    return stack_plots(_join_sheets([to_picture(sheet) for sheet in sheets]), _plots(evaluation))


def _warp_sheet(pair: WarpedPair) -> Tensor:
    """Draw a view, another one warped onto it, and their difference, for the edited and original scenes."""
    depth = pair.depth
    visible = depth > 0
    near, far = (float(depth[visible].quantile(q)) if bool(visible.any()) else q for q in (0.02, 0.98))
    gray = torch.where(visible, 1 - 0.85 * ((depth - near) / max(far - near, 1e-9)).clamp(0, 1), 1.0)
    rows = []
    for whose in (EDITED, UNEDITED):
        view, warped = pair.pictures[whose]
        difference = 1 - (_DIFFERENCE_GAIN * (warped - view).abs()).clamp(0, 1)
        both = torch.where(pair.both[..., None], view, 0.35 * view + 0.65)
        rows.append([view, both, warped, difference, gray[..., None].expand(-1, -1, 3)])
    return contact_sheet(
        [[thumbnail(image, _THUMBNAIL_WIDTH) for image in row] for row in rows],
        [EDITED, UNEDITED],
        [
            pair.target,
            "seen by both",
            f"{pair.source} warped",
            f"difference × {_DIFFERENCE_GAIN}",
            "depth",
        ],
        "One held-out view warped onto another by rendered depth",
    )


def _plots(evaluation: Evaluation) -> list[list[Plot]]:
    lpips = "LPIPS" if evaluation.perceptual.startswith("lpips") else evaluation.perceptual
    curves = evaluation.curves
    paths = evaluation.paths
    psnr = {name: (curve.s, curve.psnr) for name, curve in curves.items()}
    perceptual = {name: (curve.s, curve.lpips) for name, curve in curves.items()}
    steps = {name: (middles(len(path.steps)), path.steps) for name, path in paths.items()}
    change = {name: (even(len(path.from_original)), path.from_original) for name, path in paths.items()}
    return [
        [
            Plot("PSNR to the edited views, dB", psnr, "slider", span=_SPAN),
            Plot(f"{lpips} to the edited views", perceptual, "slider", low=0.0, span=_SPAN),
        ],
        [
            Plot(f"{lpips} between neighboring slider values", steps, "slider", low=0.0, span=_SPAN),
            Plot(f"{lpips} from the original", change, "slider", low=0.0, span=_SPAN),
        ],
    ]


def _join_sheets(sheets: Sequence[Image.Image]) -> Image.Image:
    """Stack sheets on one page."""
    page = Image.new("RGB", (max(s.width for s in sheets), sum(s.height for s in sheets)), PAPER)
    top = 0
    for sheet in sheets:
        page.paste(sheet, (0, top))
        top += sheet.height
    return page


def evaluate(options: EvaluateOptions) -> list[Evaluation]:
    """Measure a finished run, or all runs of a batch, and print the table.

    Raises:
        ProgdfError: the folder is not a finished run, one of its files is damaged, or its scene is missing or
            differs.
    """
    if options.methods or options.seed:
        raise ProgdfError("--methods and --seed belong to a suite; add --suite sliders")
    prepare_process(options.threads)
    perceptual, warning = perceptual_loss()
    if warning:
        print_line(warning.replace("training with", "measuring with"))
    root = options.run
    reports = [] if (root / "report.json").is_file() else sorted(root.glob("*/*/report.json"))
    if not reports:
        evaluation = _evaluate_run(options, perceptual)
        for line in evaluation_table(evaluation).splitlines():
            print_line(line)
        print_line(f"wrote {root / 'evaluation.json'} and evaluation.png")
        return [evaluation]
    evaluations = [_evaluate_run(replace(options, run=report.parent), perceptual) for report in reports]
    names = [report.parent.relative_to(root).as_posix() for report in reports]
    for line in summary_table(names, evaluations).splitlines():
        print_line(line)
    print_line(f"wrote evaluation.json and evaluation.png into the folder of each of {len(reports)} runs")
    return evaluations


def _evaluate_run(options: EvaluateOptions, perceptual: Perceptual) -> Evaluation:
    """Measure one run and write RUN/evaluation.json and evaluation.png."""
    opened = open_run(options.run, options.scene)
    texts = effective_texts(options.texts, opened.run.record.plan.texts)
    evaluation = evaluate_run(opened, perceptual, texts)
    folder = opened.run.folder
    write_json(folder.root / "evaluation.json", evaluation_json(evaluation))
    write_image(folder.root / "evaluation.png", evaluation_picture(opened, evaluation))
    return evaluation
