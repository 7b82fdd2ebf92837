"""Work on several processes or machines, which Dask distributes.

The engine holds no state: files on a disk that all workers share tell what is done. So a worker
that dies costs what it had at hand, and the same command resumes a stopped one.

- `workers`: processes of this machine, or the workers of a running scheduler, and their checks.
- `frames`: the frames of one movie.
- `batch`: many captures, and what is to be done with each.
- `on_worker`: what runs in a worker.
"""
