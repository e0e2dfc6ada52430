"""A view to train on: its image is asked for by a method, its matrices are on the CPU."""

from utils import plain_camera


class Camera(plain_camera.Camera):
    def get_original_image(self, load_from_h5=False):
        return self.original_image
