"""From bare photos or a video to posed pictures: structure from motion with pycolmap."""
