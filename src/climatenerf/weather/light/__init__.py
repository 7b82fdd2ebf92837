"""The light of the place: today the sun's position, which other effects read."""
