"""Image quality of a fitted field in the held-out views."""

from collections.abc import Callable

import numpy as np

from climatenerf.evaluation.appearance import nearby_appearance
from climatenerf.evaluation.metrics import psnr, psnr_cc, ssim
from climatenerf.field.hash_field import Field
from climatenerf.render.volume import render_view
from climatenerf.scene.images import downscaled_camera, load_image, load_mask
from climatenerf.scene.scene import Scene


def evaluate(
    field: Field,
    scene: Scene,
    downscale: int,
    after_view: Callable[[int, int], None],
    nearby: bool = True,
) -> dict:
    """Measure PSNR, SSIM and colour-corrected PSNR of the held-out views.

    Nothing is learned from the held-out photos. Only pixels that a view's mask leaves count; in the
    windows of SSIM the masked ones are the photo's. A view that is masked entirely is left out.

    Args:
        field: the fitted field.
        scene: its scene, with held-out views.
        downscale: factor by which the photos are reduced.
        after_view: called with (views done, views) after each view.
        nearby: render each view in the appearance of the training photos nearest to it; False: in
            the mean appearance.

    Returns:
        Means by name, and `views` with the values of each; means are None without held-out views.
    """
    rows = {}
    views = scene.of_split("heldout")
    photos = np.stack([scene.c2w_world(view) for view in scene.of_split("train")])
    for index, view in enumerate(views):
        truth = load_image(view, scene, downscale).astype(np.float32) / 255
        usable = load_mask(view, scene, downscale)
        usable = np.ones(truth.shape[:2], bool) if usable is None else usable
        if usable.any():
            camera = downscaled_camera(scene.cameras[view.camera], downscale)
            c2w = scene.c2w_world(view)
            appearance = nearby_appearance(field, photos, c2w) if nearby else None
            picture = render_view(field, camera, c2w, appearance)
            rendered, wanted = picture[usable][:, None], truth[usable][:, None]
            rows[view.name] = {
                "psnr": psnr(rendered, wanted),
                "ssim": ssim(np.where(usable[..., None], picture, truth), truth),
                "psnr_cc": psnr_cc(rendered, wanted),
            }
        after_view(index + 1, len(views))
    if not rows:
        return {"psnr": None, "ssim": None, "psnr_cc": None, "views": {}}
    means: dict = {"heldout_appearance": "nearby" if nearby else "mean"}
    means |= {
        key: float(np.mean([row[key] for row in rows.values()]))
        for key in ("psnr", "ssim", "psnr_cc")
    }
    return means | {"views": rows}
