"""Class labels of photos by a segmentation network, as Cityscapes train ids."""

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

# What the classes of other data sets, ADE20K above all, are nearest to.
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
_MAX_NUMBERS = 2**27  # of scores held at once, half a gigabyte


def train_ids(names: Mapping[int, str], model: str) -> UInt8[np.ndarray, " n"]:
    """The Cityscapes train id of each of a network's classes, 255 where there is none.

    Args:
        names: The network's own names by its class numbers, from 0 on without a gap. Of several
            words with commas between, the first counts.
        model: What to call the network in an error.

    Raises:
        UserError: Hardly any name is known.
    """
    table = np.full(max(names, default=-1) + 1, UNKNOWN, np.uint8)
    for number, words in names.items():
        name = words.replace(";", ",").split(",")[0].strip().lower().replace("_", " ")
        name = NEAREST.get(name, name)
        if name in CITYSCAPES:
            table[number] = CITYSCAPES.index(name)
    if len(set(table[table != UNKNOWN].tolist())) < MIN_CLASSES:
        some = ", ".join(list(names.values())[:3])
        raise UserError(
            f"the model {model} does not name its classes as Cityscapes or ADE20K do (it has:"
            f" {some}, ...); give one that was trained on either"
        )
    return table


def load_segmentation(name: str) -> Network:
    """A network by name or folder, whose `predict` gives train ids in the picture's own size.

    SegFormer, OneFormer and whatever else `transformers` has for semantic segmentation.

    Raises:
        UserError: It cannot be had, is no segmentation network, or names its classes otherwise.
    """
    config, processor, model = load_parts(name, _load)
    ids = train_ids({int(k): v for k, v in (config.id2label or {}).items()}, name)
    tasked = {"task_inputs": ["semantic"]} if config.model_type == "oneformer" else {}

    def predict(picture: UInt8[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "h w"]:
        import torch

        height, width = picture.shape[:2]
        # Scores of many classes for each pixel of a large photo would fill the memory.
        shrink = max(1.0, math.sqrt(len(ids) * height * width / _MAX_NUMBERS))
        size = max(1, round(height / shrink)), max(1, round(width / shrink))
        with torch.inference_mode():
            inputs = processor(images=Image.fromarray(picture), return_tensors="pt", **tasked)
            seen = model(**inputs.to(model.device))
            classes = processor.post_process_semantic_segmentation(seen, target_sizes=[size])[0]
        labels = Image.fromarray(ids[classes.cpu().numpy()])
        return np.asarray(labels.resize((width, height), Image.Resampling.NEAREST))

    return Network(name, getattr(config, "_commit_hash", None), predict)


def _load(name: str, local: bool):
    """Configuration, processor and model."""
    import torch
    import transformers

    config = transformers.AutoConfig.from_pretrained(name, local_files_only=local)
    if type(config) in transformers.MODEL_FOR_SEMANTIC_SEGMENTATION_MAPPING:
        kind = transformers.AutoModelForSemanticSegmentation
    elif type(config) in transformers.MODEL_FOR_UNIVERSAL_SEGMENTATION_MAPPING:
        kind = transformers.AutoModelForUniversalSegmentation
    else:
        raise UserError(f"the model {name} is no network for segmentation ({config.model_type})")
    if config.model_type == "oneformer":
        # Its class names are wanted for training only, and would be fetched from elsewhere.
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
