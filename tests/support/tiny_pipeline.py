"""Tiny pipelines of the real classes of diffusers, with random weights, saved to a folder."""

import json
from pathlib import Path

import torch
import transformers as tf
from diffusers import (
    AutoencoderKL,
    DDIMScheduler,
    FlowMatchEulerDiscreteScheduler,
    FluxFillPipeline,
    FluxTransformer2DModel,
    StableDiffusionInpaintPipeline,
    StableDiffusionPipeline,
    UNet2DConditionModel,
)


def save_pipeline(folder: Path, inpainting: bool = True, seed: int = 0) -> Path:
    """Save a Stable Diffusion pipeline: of the inpainting class, or the one from text alone."""
    torch.manual_seed(seed)
    words = folder / "words"
    words.mkdir(parents=True)
    letters = [chr(c) for c in (*range(33, 127), *range(161, 173), *range(174, 256))]
    names = [*letters, *(f"{letter}</w>" for letter in letters), "<|startoftext|>", "<|endoftext|>"]
    (words / "vocab.json").write_text(json.dumps({w: i for i, w in enumerate(names)}))
    (words / "merges.txt").write_text("#version: 0.2\n")
    text = tf.CLIPTextConfig(
        vocab_size=len(names),
        hidden_size=16,
        intermediate_size=16,
        num_hidden_layers=1,
        num_attention_heads=2,
        max_position_embeddings=77,
        bos_token_id=len(names) - 2,
        eos_token_id=len(names) - 1,
        pad_token_id=len(names) - 1,
    )
    unet = UNet2DConditionModel(
        block_out_channels=(8, 16),
        norm_num_groups=4,
        layers_per_block=1,
        sample_size=8,
        in_channels=9 if inpainting else 4,  # noise, mask and masked picture
        out_channels=4,
        down_block_types=("DownBlock2D", "CrossAttnDownBlock2D"),
        up_block_types=("CrossAttnUpBlock2D", "UpBlock2D"),
        cross_attention_dim=16,
        attention_head_dim=2,
    )
    kind = StableDiffusionInpaintPipeline if inpainting else StableDiffusionPipeline
    pipeline = kind(
        vae=_autoencoder(),
        text_encoder=tf.CLIPTextModel(text),
        tokenizer=tf.CLIPTokenizer.from_pretrained(words, model_max_length=77),
        unet=unet,
        scheduler=DDIMScheduler(steps_offset=1, clip_sample=False),
        safety_checker=None,
        feature_extractor=None,
        requires_safety_checker=False,
    )
    pipeline.save_pretrained(folder / "pipeline")
    return folder / "pipeline"


def save_flux_fill(folder: Path) -> Path:
    """Save a FluxFillPipeline: another text encoder, a transformer, 16 pixels a token."""
    words = StableDiffusionInpaintPipeline.from_pretrained(save_pipeline(folder / "words"))
    torch.manual_seed(0)
    letters = [(letter, -1.0) for letter in "\u2581abcdefghijklmnopqrstuvwxyz"]
    vocabulary = [("<pad>", 0.0), ("</s>", 0.0), ("<unk>", 0.0), *letters]
    text = tf.T5Config(vocab_size=64, d_model=32, d_kv=8, d_ff=16, num_layers=1, num_heads=2)
    transformer = FluxTransformer2DModel(
        patch_size=1,
        in_channels=16 + 16 + 256,  # noise, masked picture, and the mask of 16 x 16 pixels
        out_channels=16,
        num_layers=1,
        num_single_layers=1,
        attention_head_dim=16,
        num_attention_heads=2,
        joint_attention_dim=32,
        pooled_projection_dim=16,
        guidance_embeds=True,
        axes_dims_rope=[4, 4, 8],
    )
    pipeline = FluxFillPipeline(
        scheduler=FlowMatchEulerDiscreteScheduler(),
        vae=_autoencoder(use_quant_conv=False, use_post_quant_conv=False, shift_factor=0.1),
        text_encoder=words.text_encoder,
        tokenizer=words.tokenizer,
        text_encoder_2=tf.T5EncoderModel(text),
        tokenizer_2=tf.T5Tokenizer(vocab=vocabulary, extra_ids=0, model_max_length=32),
        transformer=transformer,
    )
    pipeline.save_pretrained(folder / "flux")
    return folder / "flux"


def _autoencoder(**changes) -> AutoencoderKL:
    return AutoencoderKL(
        block_out_channels=(8, 8, 8, 8),
        norm_num_groups=4,
        in_channels=3,
        out_channels=3,
        down_block_types=("DownEncoderBlock2D",) * 4,
        up_block_types=("UpDecoderBlock2D",) * 4,
        latent_channels=4,
        **changes,
    )
