"""Structure from motion with pycolmap: posed pictures from photos or a video."""
