"""Weather effects: each a package of parameters, physics and entity, listed in `registry`.

`effect`, `registry`, `weather`, `description`, `units` and the `parameters` of each effect load no
torch; `world`, `media` and the physics do.
"""
