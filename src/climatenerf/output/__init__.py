"""Files made of frames: layers, movies, contact sheets."""
