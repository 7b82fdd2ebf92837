"""How often a render asks whether to stop."""

import torch

from climatenerf.field.compositing import MIN_CHUNK, STAGE_SECONDS, Checkpoints, chunks


class Never:
    def __init__(self, every=None):
        if every is not None:
            self.every = every

    def __call__(self):
        return False


def largest(cancelled, pace):
    """Largest chunk of rays of which each takes `pace` seconds, by a clock of its own."""
    checkpoint, sizes = Checkpoints(cancelled), []
    rays = torch.zeros(60_000, 3)
    for part in chunks(rays, checkpoint):
        sizes.append(min(part.stop, len(rays)) - part.start)
        checkpoint._last -= pace * sizes[-1]
    return max(sizes[:-1])


def test_a_longer_time_between_questions_gives_larger_chunks():
    pace = 1e-5
    usual, patient = largest(Never(), pace), largest(Never(0.08), pace)
    assert Checkpoints(Never()).every == STAGE_SECONDS
    assert MIN_CHUNK <= usual <= 2.2 * STAGE_SECONDS / pace
    assert 3 * usual < patient <= 2.2 * 0.08 / pace
