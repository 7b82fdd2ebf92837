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
