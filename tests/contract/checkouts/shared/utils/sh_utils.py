"""Spherical harmonics."""

from lapgs_plugin.fields.spherical_harmonics import sh_basis

C0 = 0.28209479177387814


def eval_sh(deg, sh, dirs):
    basis = sh_basis(dirs, deg)  # (n, (deg + 1)^2)
    return (sh[..., : basis.shape[1]] * basis[:, None]).sum(-1)


def RGB2SH(rgb):
    return (rgb - 0.5) / C0


def SH2RGB(sh):
    return sh * C0 + 0.5
