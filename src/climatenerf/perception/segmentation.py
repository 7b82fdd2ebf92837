"""Class labels (Cityscapes train ids) of photos by a semantic segmentation network."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
from jaxtyping import UInt8
from PIL import Image

from climatenerf.core.errors import UserError
from climatenerf.perception.models import Network, load_parts
from climatenerf.scene.label_spaces import UNKNOWN

CITYSCAPES = (
    "road", "sidewalk", "building", "wall", "fence", "pole", "traffic light", "traffic sign",
    "vegetation", "terrain", "sky", "person", "rider", "car", "truck", "bus", "train",
    "motorcycle", "bicycle",
)  # fmt: skip
"""Names of the train ids 0 to 18."""

# Nearest Cityscapes class of classes of other data sets, mainly ADE20K.
NEAREST = {
    "house": "building",
    "skyscraper": "building",
    "hovel": "building",
    "tower": "building",
    "tree": "vegetation",
    "palm": "vegetation",
    "plant": "vegetation",
    "flower": "vegetation",
    "grass": "terrain",
    "earth": "terrain",
    "field": "terrain",
    "land": "terrain",
    "sand": "terrain",
    "dirt track": "terrain",
    "path": "sidewalk",
    "pavement": "sidewalk",
    "runway": "road",
    "railing": "fence",
    "streetlight": "pole",
    "street lamp": "pole",
    "van": "car",
    "minibike": "motorcycle",
    "signboard": "traffic sign",
}
MIN_CLASSES = 3
"""Cityscapes classes that a network must have."""
_MAX_SCORES = 2**27  # float32 class scores held at once: half a gigabyte


def train_ids(names: Mapping[int, str], model: str) -> UInt8[np.ndarray, " n"]:
    """Return the Cityscapes train id of each of a network's classes, 255 where there is none.

    Args:
        names: The network's class names by class index, 0 to n-1. Of several names separated by
            commas or semicolons, the first counts.
        model: The network's name in an error message.

    Raises:
        UserError: Fewer than `MIN_CLASSES` classes are recognised.
    """
    table = np.full(max(names, default=-1) + 1, UNKNOWN, np.uint8)
    for index, synonyms in names.items():
        name = synonyms.replace(";", ",").split(",")[0].strip().lower().replace("_", " ")
        name = NEAREST.get(name, name)
        if name in CITYSCAPES:
            table[index] = CITYSCAPES.index(name)
    if len(set(table[table != UNKNOWN].tolist())) < MIN_CLASSES:
        examples = ", ".join(list(names.values())[:3])
        raise UserError(
            f"the model {model} does not name its classes as Cityscapes or ADE20K do (it has:"
            f" {examples}, ...); give a model trained on one of them"
        )
    return table


def load_segmentation(name: str) -> Network:
    """Load a segmentation network by name or folder.

    SegFormer, OneFormer, or any other semantic segmentation network of `transformers`. Its
    `predict` maps a picture `h w 3` to train ids `h w`.

    Raises:
        UserError: The network cannot be loaded, is of another kind, or has unknown class names.
    """
    config, processor, model = load_parts(name, _load)
    ids = train_ids({int(k): v for k, v in (config.id2label or {}).items()}, name)
    task = {"task_inputs": ["semantic"]} if config.model_type == "oneformer" else {}

    def predict(picture: UInt8[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "h w"]:
        import torch

        height, width = picture.shape[:2]
        # Scores of all classes at full resolution could exceed the memory.
        shrink = max(1.0, math.sqrt(len(ids) * height * width / _MAX_SCORES))
        size = max(1, round(height / shrink)), max(1, round(width / shrink))
        with torch.inference_mode():
            inputs = processor(images=Image.fromarray(picture), return_tensors="pt", **task)
            output = model(**inputs.to(model.device))
            classes = processor.post_process_semantic_segmentation(output, target_sizes=[size])[0]
        labels = Image.fromarray(ids[classes.cpu().numpy()])
        return np.asarray(labels.resize((width, height), Image.Resampling.NEAREST))

    return Network(name, getattr(config, "_commit_hash", None), predict)


def _load(name: str, local: bool):
    """Return configuration, processor and model."""
    import torch
    import transformers

    config = transformers.AutoConfig.from_pretrained(name, local_files_only=local)
    if type(config) in transformers.MODEL_FOR_SEMANTIC_SEGMENTATION_MAPPING:
        kind = transformers.AutoModelForSemanticSegmentation
    elif type(config) in transformers.MODEL_FOR_UNIVERSAL_SEGMENTATION_MAPPING:
        kind = transformers.AutoModelForUniversalSegmentation
    else:
        raise UserError(
            f"the model {name} is not a segmentation network ({config.model_type}); give a"
            " SegFormer or another semantic segmentation network of transformers"
        )
    if config.model_type == "oneformer":
        # Only training needs its file of class names, which would be downloaded separately.
        images = transformers.AutoImageProcessor.from_pretrained(
            name, local_files_only=local, class_info_file=None
        )
        words = transformers.AutoTokenizer.from_pretrained(name, local_files_only=local)
        processor = transformers.OneFormerProcessor(
            images, words, task_seq_length=config.task_seq_len
        )
    else:
        processor = transformers.AutoImageProcessor.from_pretrained(name, local_files_only=local)
    model = kind.from_pretrained(name, config=config, local_files_only=local)
    return config, processor, model.eval().to("cuda" if torch.cuda.is_available() else "cpu")
