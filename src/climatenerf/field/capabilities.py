"""What a field can answer beside colours, for `RadianceField.capabilities`.

Does not import torch.
"""

DENSITY = "density"
"""`density` answers at any position."""
NORMALS = "normals"
"""`surface_heads` gives normals that were learned."""
CLASSES = "classes"
"""`surface_heads` gives class logits that were learned."""
APPEARANCE = "appearance"
"""`colour` and `sky` depend on an appearance vector."""
OBSERVED = "observed space"
"""`observed_only` leaves out what no photo shows."""
FUSED = "fused compositing"
"""`composite` marches, evaluates and composites rays in one launch."""
COMPLETES = "completed ground"
"""`march` marks samples on ground that no photo shows, see `core.samples.COMPLETED`; and
`ground_height` returns the height of the ground."""
