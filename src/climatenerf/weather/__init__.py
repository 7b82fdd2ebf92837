"""Weather: its parameters and its physics.

`parameters`, `units`, `description` and `spectrum` load no torch; the rest of the physics (`smog`,
`flood`, `waves`, `fresnel`, `snow`) does.
"""
