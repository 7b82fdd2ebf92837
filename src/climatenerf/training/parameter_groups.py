"""Learning rates of the networks: which parameters share which."""

from climatenerf.field.hash_field import Field
from climatenerf.training.poses import PoseCorrections
from climatenerf.training.schedule import Rates
from climatenerf.training.settings import FitSettings
from climatenerf.training.transients import TransientMasks


def parameter_groups(
    field: Field,
    masks: TransientMasks,
    poses: PoseCorrections,
    settings: FitSettings,
    knows_sky: bool,
) -> list[dict]:
    """Return the networks' parameters as PyTorch's groups, each with its `rates`.

    Args:
        field: with networks and appearance vectors; hash grids have an optimiser of their own.
        masks: of passers-by.
        poses: corrections.
        settings: with the schedule of the rates.
        knows_sky: whether sky pixels are labelled.
    """
    schedule, whole = settings.schedule, (1.0, 1.0)
    named = dict(field.named_parameters())

    def group(rates: Rates, *prefixes: str) -> dict:
        chosen = [p for name, p in named.items() if name.startswith(prefixes)]
        return {"params": chosen, "rates": rates}

    return [
        group(whole, "geometry_net", "colour_net"),
        group(whole, "surface_net"),
        group(schedule.view if settings.warm_up else whole, "view_net"),
        group(whole if knows_sky else schedule.unlabelled_sky, "sky_net"),
        group(schedule.embeddings, "embeddings"),
        {"params": list(masks.parameters()), "rates": schedule.masks},
        {"params": list(poses.parameters()), "rates": schedule.poses},
    ]
