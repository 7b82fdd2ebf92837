import torch

from climatenerf.training.optimiser import GridAdam


def test_rows_with_gradients_follow_adam_and_others_stay():
    generator = torch.Generator().manual_seed(0)
    start = torch.randn(2, 16, 2, generator=generator)
    table = torch.nn.Parameter(start.clone())
    twin = torch.nn.Parameter(start.clone())
    ours = GridAdam([table])
    adam = torch.optim.Adam([twin], lr=0.01, betas=(0.9, 0.99), eps=1e-15)
    touched = torch.zeros_like(start, dtype=torch.bool)
    touched[0, :5] = True
    for _ in range(5):
        gradient = torch.randn(start.shape, generator=generator) * touched
        table.grad_buffer.copy_(gradient)
        twin.grad = gradient
        ours.step(0.01)
        adam.step()
    assert torch.allclose(table[touched], twin[touched], atol=1e-5)
    assert torch.equal(table[~touched], start[~touched])
    assert (table.grad_buffer == 0).all()


def test_values_fall_by_their_share_of_the_rate_whether_they_have_a_gradient_or_not():
    """After 16 steps by decoupled decay (AdamW), but for the order of the two within 8 steps."""
    generator = torch.Generator().manual_seed(0)
    start = torch.randn(2, 16, 2, generator=generator)
    table, twin = (torch.nn.Parameter(start.clone()) for _ in range(2))
    ours = GridAdam([table], decays=[0.5])
    adam = torch.optim.AdamW([twin], lr=0.01, betas=(0.9, 0.99), eps=1e-15, weight_decay=0.5)
    touched = torch.arange(16)[None, :, None] < 5
    rest = ~touched.expand_as(start)
    for _ in range(16):
        gradient = torch.randn(start.shape, generator=generator) * touched
        table.grad_buffer.copy_(gradient)
        twin.grad = gradient
        ours.step(0.01)
        adam.step()
    assert torch.allclose(table, twin, atol=6e-3)
    assert (table - start)[rest].abs().max() > 0.1
    expected = start * 0.96**2  # 1 - 8 · .01 · .5, twice
    assert torch.allclose(table[rest], expected[rest], atol=1e-6)
