"""Make a scene from photos or a video: structure from motion, unless there is a model, and undistortion with pycolmap.

OUT/images/            undistorted photos under their own names
OUT/masks/             undistorted masks, if there are any
OUT/sparse/0/          the model: PINHOLE cameras, poses, points with their tracks
OUT/.prepare/          while unfinished: COLMAP's database and models, to continue an interrupted run
"""
