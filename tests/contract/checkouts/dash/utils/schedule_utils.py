"""DashGaussian's schedule: small renders first, and a budget of Gaussians that follows the size of the renders."""


class TrainingScheduler:
    def __init__(self, opt, pipe, gaussians, original_images):
        self.densify_mode, self.resolution_mode = pipe.densify_mode, pipe.resolution_mode
        self.densify_until_iter = opt.densify_until_iter
        self.init_n_gaussian = len(gaussians.get_xyz)
        if pipe.max_n_gaussian > 0:
            self.max_n_gaussian, self.momentum = pipe.max_n_gaussian, -1
        else:
            self.momentum = 5 * self.init_n_gaussian
            self.max_n_gaussian = self.init_n_gaussian + self.momentum
        # The real one finds scales by the images' spectra; all must have one size.
        assert len({image.shape for image in original_images}) == 1

    def update_momentum(self, momentum_step):
        if self.momentum != -1:
            self.momentum = max(self.momentum, int(0.98 * self.momentum + int(momentum_step)))
            self.max_n_gaussian = self.init_n_gaussian + self.momentum

    def get_res_scale(self, iteration):
        if self.resolution_mode == "const":
            return 1
        return max(1, 3 - int(3 * iteration / self.densify_until_iter))

    def get_densify_rate(self, iteration, cur_n_gaussian, cur_scale=None):
        if self.densify_mode == "free":
            return 1.0
        share = 1 / cur_scale ** (2 - iteration / self.densify_until_iter)
        next_n_gaussian = int((self.max_n_gaussian - self.init_n_gaussian) * share) + self.init_n_gaussian
        return min(max((next_n_gaussian - cur_n_gaussian) / cur_n_gaussian, 0.0), 0.2)
