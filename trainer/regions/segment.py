"""Segmentation of the object that a prompt names, by two pretrained networks.

GroundingDINO (Liu et al. 2023) finds boxes, and SAM (Kirillov et al. 2023) finds masks.
Together they are the LangSAM of the paper. Weights are read from this machine and never downloaded
implicitly.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Protocol

import torch
from torch import Tensor

from progdf.errors import ProgdfError
from progdf.io.images import to_picture
from progdf.system.packages import install_extra
from trainer.options import DETECTOR, SAM_MODEL, RegionOptions
from trainer.store import pretrained
from trainer.store.pretrained import BROKEN, folder_of_model, model_device, weights_here


class Segmenter(Protocol):
    """Segmenter of the objects that a prompt names."""

    def __call__(self, image: Tensor, prompt: str) -> Tensor:
        """Return the mask of the objects, empty if there are none. [H,W,3], 0 to 1 -> [H,W] bool"""
        ...


@dataclass(frozen=True)
class GroundedSam:
    """Detector and segmentation network with their processors; create it with `grounded_sam`."""

    # detector, detector_processor: `GroundingDinoForObjectDetection`, `GroundingDinoProcessor`
    detector: Any
    detector_processor: Any
    # sam_model, sam_processor: `SamModel`, `SamProcessor`
    sam_model: Any
    sam_processor: Any
    box_threshold: float  # minimum confidence of a detection, 0 to 1

    def __call__(self, image: Tensor, prompt: str) -> Tensor:
        """Return the union of the masks of all detections, see `Segmenter`."""
        picture = to_picture(image)
        boxes = self.boxes(picture, prompt)
        if not len(boxes):
            return torch.zeros(image.shape[:2], dtype=torch.bool)
        inputs = self.sam_processor(images=picture, input_boxes=[boxes.tolist()], return_tensors="pt")
        with torch.no_grad():
            outlines = self.sam_model(
                pixel_values=inputs["pixel_values"].to(self.sam_model.device),
                input_boxes=inputs["input_boxes"].to(self.sam_model.device, torch.float32),
                multimask_output=False,
            )
        masks: Tensor = self.sam_processor.post_process_masks(
            outlines.pred_masks.cpu(), inputs["original_sizes"], inputs["reshaped_input_sizes"]
        )[0]
        return masks.bool().flatten(0, 1).any(dim=0)

    def boxes(self, picture: Any, prompt: str) -> Tensor:
        """Return x0, y0, x1, y1 in pixels of all detections in a PIL image. [B,4]"""
        inputs = self.detector_processor(images=picture, text=normalize_prompt(prompt), return_tensors="pt")
        inputs = inputs.to(self.detector.device)
        with torch.no_grad():
            outputs = self.detector(**inputs)
        detections = self.detector_processor.post_process_grounded_object_detection(
            outputs,
            inputs["input_ids"],
            threshold=self.box_threshold,
            text_threshold=self.box_threshold,
            target_sizes=[(picture.height, picture.width)],
        )[0]
        boxes: Tensor = detections["boxes"].float().cpu()
        return boxes


def normalize_prompt(prompt: str) -> str:
    """Return a prompt in the format of GroundingDINO's training: lower case, ending in a full stop."""
    words = " ".join(prompt.lower().split()).rstrip(". ")
    return f"{words}."


def grounded_sam(options: RegionOptions) -> GroundedSam:
    """Load both networks from this machine.

    Raises:
        ProgdfError: transformers is not installed, weights are missing or broken, or a model has the wrong
            type.
    """
    try:
        from transformers import (
            AutoConfig,
            GroundingDinoForObjectDetection,
            GroundingDinoProcessor,
            SamModel,
            SamProcessor,
        )
        from transformers.utils import logging as transformers_logging
    except ImportError as error:
        raise _import_failure(error) from error
    pretrained.keep_quiet(transformers_logging)

    def load(model: str, kind: str, option: str, usual: str, network: Any, processor: Any) -> tuple[Any, Any]:
        try:
            _check_kind(AutoConfig.from_pretrained(model, local_files_only=True), model, kind, option, usual)
            loaded = network.from_pretrained(model, local_files_only=True, use_safetensors=True)
            return (
                loaded.float().eval().to(model_device()),
                processor.from_pretrained(model, local_files_only=True),
            )
        except ProgdfError:
            raise
        except BROKEN as error:
            raise _missing(model, option) from error

    detector = load(
        options.detector,
        "grounding-dino",
        "--detector",
        DETECTOR,
        GroundingDinoForObjectDetection,
        GroundingDinoProcessor,
    )
    sam_model = load(options.sam_model, "sam", "--sam-model", SAM_MODEL, SamModel, SamProcessor)
    return GroundedSam(*detector, *sam_model, options.box_threshold)


def check_grounded_sam(options: RegionOptions) -> None:
    """Raise the errors of `grounded_sam` that can be found without loading a network.

    Raises:
        ProgdfError: see `grounded_sam`.
    """
    try:
        from transformers import AutoConfig
    except ImportError as error:
        raise _import_failure(error) from error
    for model, kind, option, usual in (
        (options.detector, "grounding-dino", "--detector", DETECTOR),
        (options.sam_model, "sam", "--sam-model", SAM_MODEL),
    ):
        try:
            _check_kind(AutoConfig.from_pretrained(model, local_files_only=True), model, kind, option, usual)
            weights_here(folder_of_model(model, "config.json"))
        except BROKEN as error:
            raise _missing(model, option) from error


def _check_kind(config: Any, model: str, kind: str, option: str, usual: str) -> None:
    if config.model_type != kind:
        raise ProgdfError(f"{model} is a {config.model_type} model, not {kind}; give {option} {usual}")


def _import_failure(error: ImportError) -> ProgdfError:
    return ProgdfError(f"text: needs the package transformers ({error}); {install_extra('segment')}")


def _missing(model: str, option: str) -> ProgdfError:
    download = f"', or give {option} the folder of a saved model"
    return pretrained.missing_weights(model, "model", f"; give {option} such a folder", download)


SEGMENTERS: Mapping[str, Callable[[RegionOptions], Segmenter]] = {"text": grounded_sam}
"""Kind of region → constructor of its segmenter, which loads the networks."""

SEGMENTER_CHECKS: Mapping[str, Callable[[RegionOptions], None]] = {"text": check_grounded_sam}
"""Kind of region → check that raises a ProgdfError if the segmenter cannot be made; loads no weights."""
