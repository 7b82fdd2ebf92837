import torch

from climatenerf.training.optimiser import GridAdam


def after_steps(
    decay: float, touched: torch.Tensor, steps: int
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """A table before and after steps with gradients in `touched`, and after AdamW's steps."""
    generator = torch.Generator().manual_seed(0)
    start = torch.randn(2, 16, 2, generator=generator)
    table, twin = (torch.nn.Parameter(start.clone()) for _ in range(2))
    ours = GridAdam([table], [decay])
    theirs = torch.optim.AdamW([twin], lr=0.01, betas=(0.9, 0.99), eps=1e-15, weight_decay=decay)
    for _ in range(steps):
        gradient = torch.randn(start.shape, generator=generator) * touched
        table.grad_buffer.copy_(gradient)
        twin.grad = gradient
        ours.step(0.01)
        theirs.step()
    assert (table.grad_buffer == 0).all()
    return start, table.data, twin.data


def test_rows_with_gradients_follow_adam_and_others_are_unchanged():
    touched = torch.zeros(2, 16, 2, dtype=torch.bool)
    touched[0, :5] = True
    start, ours, theirs = after_steps(0.0, touched, 5)
    assert torch.allclose(ours[touched], theirs[touched], atol=1e-5)
    assert torch.equal(ours[~touched], start[~touched])


def test_weight_decay_applies_with_and_without_gradients():
    """As in AdamW, except that it is applied every eight steps."""
    touched = (torch.arange(16) < 5)[None, :, None].expand(2, 16, 2)
    start, ours, theirs = after_steps(0.5, touched, 16)
    assert torch.allclose(ours, theirs, atol=6e-3)
    expected = start * 0.96**2  # 1 - 8 · .01 · .5, twice
    assert torch.allclose(ours[~touched], expected[~touched], atol=1e-6)
    assert (ours - start)[~touched].abs().max() > 0.1
