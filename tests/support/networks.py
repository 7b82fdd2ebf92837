"""Tiny networks with random weights, saved in the format of the large ones."""

import json
from pathlib import Path

import numpy as np
import torch
import transformers as tf

STREET_NAMES = ("road", "sky", "vegetation", "person", "bicycle")
ROOM_NAMES = ("wall, or the like", "sky", "tree", "house", "ceiling", "grass")


def _numbered(names):
    return {number: name for number, name in enumerate(names)}


def save_segformer(folder: Path, names=STREET_NAMES, seed=0) -> Path:
    torch.manual_seed(seed)
    config = tf.SegformerConfig(
        num_encoder_blocks=2,
        depths=[1, 1],
        sr_ratios=[4, 2],
        hidden_sizes=[8, 16],
        patch_sizes=[7, 3],
        strides=[4, 2],
        num_attention_heads=[1, 2],
        mlp_ratios=[2, 2],
        decoder_hidden_size=16,
        id2label=_numbered(names),
        label2id={name: number for number, name in enumerate(names)},
    )
    tf.SegformerForSemanticSegmentation(config).save_pretrained(folder)
    tf.SegformerImageProcessorPil(size={"height": 64, "width": 64}).save_pretrained(folder)
    return folder


def save_depth_anything(folder: Path, kind="relative") -> Path:
    torch.manual_seed(0)
    backbone = tf.Dinov2Config(
        hidden_size=16,
        num_hidden_layers=2,
        num_attention_heads=2,
        image_size=42,
        patch_size=14,
        out_features=["stage1", "stage2"],
        reshape_hidden_states=False,
    )
    config = tf.DepthAnythingConfig(
        backbone_config=backbone,
        reassemble_hidden_size=16,
        reassemble_factors=[2, 1],
        neck_hidden_sizes=[8, 16],
        fusion_hidden_size=8,
        head_hidden_size=8,
        depth_estimation_type=kind,
        max_depth=20,
    )
    model = tf.DepthAnythingForDepthEstimation(config)
    # Random weights give about nothing, which the last activation may cut to plain 0.
    torch.nn.init.constant_(model.head.conv3.bias, 0.3)
    model.save_pretrained(folder)
    tf.DPTImageProcessorPil(
        size={"height": 42, "width": 42}, keep_aspect_ratio=True, ensure_multiple_of=14
    ).save_pretrained(folder)
    return folder


def save_oneformer(folder: Path, names=STREET_NAMES) -> Path:
    torch.manual_seed(0)
    folder.mkdir(parents=True, exist_ok=True)
    backbone = tf.SwinConfig(
        image_size=64,
        embed_dim=16,
        depths=[1, 1, 1, 1],
        num_heads=[2, 2, 2, 2],
        window_size=2,
        out_features=["stage1", "stage2", "stage3", "stage4"],
    )
    config = tf.OneFormerConfig(
        backbone_config=backbone,
        num_queries=6,
        hidden_dim=32,
        conv_dim=32,
        mask_dim=32,
        encoder_feedforward_dim=32,
        dim_feedforward=32,
        encoder_layers=1,
        decoder_layers=2,
        query_dec_layers=1,
        num_attention_heads=2,
        text_encoder_width=16,
        text_encoder_num_layers=1,
        text_encoder_vocab_size=600,
        is_training=False,
        id2label=_numbered(names),
        label2id={name: number for number, name in enumerate(names)},
    )
    tf.OneFormerForUniversalSegmentation(config).save_pretrained(folder)
    # As on the Hub: the file of class names is named but lies elsewhere.
    (folder / "preprocessor_config.json").write_text(
        json.dumps(
            {
                "image_processor_type": "OneFormerImageProcessor",
                "size": {"shortest_edge": 64, "longest_edge": 128},
                "class_info_file": "cityscapes_panoptic.json",
                "repo_path": "nobody/has_this",
                "num_text": 2,
            }
        )
    )
    _save_clip_words(folder)
    return folder


def _save_clip_words(folder: Path) -> None:
    """A byte-level vocabulary without merges: letters, and letters that end a word."""
    letters = [chr(c) for c in (*range(33, 127), *range(161, 173), *range(174, 256))]
    words = [*letters, *(f"{letter}</w>" for letter in letters)]
    words += ["<|startoftext|>", "<|endoftext|>"]
    (folder / "vocab.json").write_text(json.dumps({w: i for i, w in enumerate(words)}))
    (folder / "merges.txt").write_text("#version: 0.2\n")
    tf.CLIPTokenizer.from_pretrained(folder).save_pretrained(folder)


def picture(height=30, width=48, seed=0):
    return np.random.default_rng(seed).integers(0, 256, (height, width, 3), dtype=np.uint8)
