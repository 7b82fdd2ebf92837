"""Comparison of our weather with stand-ins and with other programs, on one short movie.

`study.compare` renders the movie, lets every method edit it, scores the results and writes
pictures, movies, time strips and `compare.json`. Each method is a module of its own:

- `stand_ins`: eight edits that need no weights;
- `diffusion`: inpainting pipelines of `diffusers` from a local folder;
- `climategan`: ClimateGAN and ClimateGAN++ as subprocesses in a checkout of the user;
- `folder`: frames that another program made.

`uvq` scores movies with UVQ, also as a subprocess.
"""
