"""Scenes that are hard to splat, and the second implementation: Gaussian after Gaussian over all pixels."""

import torch

from meshanim.gaussians import Cameras, Gaussians

FIELDS = ("means", "quaternions", "scales", "opacities", "colors", "sh")


def cameras(width, height, count=1, seed=0, dtype=torch.float32):
    """Around the origin, about 4 m away; the principal point off the middle."""
    generator = torch.Generator().manual_seed(seed)
    poses = []
    for _ in range(count):
        rotation, _ = torch.linalg.qr(torch.eye(3) + 0.15 * torch.randn(3, 3, generator=generator))
        rotation = rotation * torch.sign(torch.diagonal(rotation))
        pose = torch.eye(4)
        pose[:3, :3] = rotation * torch.sign(torch.linalg.det(rotation))
        pose[:3, 3] = torch.tensor([0.0, 0.0, 4.0]) + 0.1 * torch.randn(3, generator=generator)
        poses.append(pose)
    focal = 1.1 * max(width, height, 16)
    k = torch.tensor([[focal, 0, 0.55 * width], [0, 0.9 * focal, 0.47 * height], [0, 0, 1]])
    return Cameras(torch.stack(poses).to(dtype), k.expand(count, 3, 3).to(dtype), width, height)


def plain(n, seed=0, channels=3, degree=None, size=0.15):
    """A cloud of about 1 m in front of `cameras`."""
    generator = torch.Generator().manual_seed(seed)

    def random(*shape):
        return torch.rand(shape, generator=generator)

    colored = {"colors": random(n, channels)}
    if degree is not None:
        colored = {"sh": 0.4 * torch.randn(n, (degree + 1) ** 2, 3, generator=generator)}
    return Gaussians(
        means=torch.randn(n, 3, generator=generator) * 0.7,
        quaternions=torch.randn(n, 4, generator=generator),
        scales=size * torch.exp(0.6 * torch.randn(n, 3, generator=generator)),
        opacities=0.05 + 0.9 * random(n),
        **colored,
    )


def hard(n, seed=0, **options):
    """`plain` with a seventh each huge, needle-thin, behind the camera, far outside, transparent, opaque and
    coincident."""
    scene = plain(n, seed, **options)
    means, scales, opacities = scene.means.clone(), scene.scales.clone(), scene.opacities.clone()
    kind = torch.arange(n) % 7
    scales[kind == 0] *= 12
    scales[kind == 1] *= torch.tensor([8.0, 0.02, 0.02])
    means[kind == 2, 2] -= 6.0
    means[kind == 3, 0] += 5.0
    opacities[kind == 4] = torch.linspace(0, 0.02, int((kind == 4).sum()))
    opacities[kind == 5] = 1.0
    means[kind == 6] = torch.tensor([0.1, -0.2, 0.3])
    return Gaussians(means, scene.quaternions, scales, opacities, scene.colors, scene.sh)


def leaves(gaussians, dtype=None):
    """The same with fields that collect gradients."""
    return gaussians.map(lambda field: field.detach().to(dtype or field.dtype).clone().requires_grad_())


def relative(value, truth):
    """Relative L2 distance."""
    value, truth = value.detach().double(), truth.detach().double()
    return float((value - truth).norm() / truth.norm().clamp_min(1e-300))


def brute_force(gaussians, cameras, background, antialiased=False, eps2d=0.3, max_alpha=0.999):
    """One camera's colours, alpha and accumulated depth by the definition, without tiles or boxes."""
    pose, k = cameras.world_to_camera[0], cameras.intrinsics[0]
    width, height = cameras.width, cameras.height
    rows, columns = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    pixels = torch.stack([columns, rows], -1).to(pose.dtype)
    transmittance = torch.ones(height, width, dtype=pose.dtype)
    done = torch.zeros(height, width, dtype=torch.bool)
    picture = torch.zeros(height, width, len(background) + 1, dtype=pose.dtype)
    depths = gaussians.means.detach() @ pose[2, :3].detach() + pose[2, 3].detach()
    for index in depths.argsort(stable=True).tolist():
        if not 0.01 <= depths[index] <= 1e10:
            continue
        x, y, z = pose[:3, :3] @ gaussians.means[index] + pose[:3, 3]
        w, i, j, h = gaussians.quaternions[index] / gaussians.quaternions[index].norm()
        turn = torch.stack(
            [
                torch.stack([1 - 2 * (j * j + h * h), 2 * (i * j - w * h), 2 * (i * h + w * j)]),
                torch.stack([2 * (i * j + w * h), 1 - 2 * (i * i + h * h), 2 * (j * h - w * i)]),
                torch.stack([2 * (i * h - w * j), 2 * (j * h + w * i), 1 - 2 * (i * i + j * j)]),
            ]
        )
        covariance = turn @ torch.diag(gaussians.scales[index] ** 2) @ turn.T
        fx, fy, cx, cy = k[0, 0], k[1, 1], k[0, 2], k[1, 2]
        sx = torch.minimum((width - cx) / fx + 0.15 * width / fx, x / z)
        sx = torch.maximum(-cx / fx - 0.15 * width / fx, sx)
        sy = torch.minimum((height - cy) / fy + 0.15 * height / fy, y / z)
        sy = torch.maximum(-cy / fy - 0.15 * height / fy, sy)
        zero = torch.zeros_like(z)
        jacobian = torch.stack([fx / z, zero, -fx * sx / z, zero, fy / z, -fy * sy / z]).reshape(2, 3)
        jacobian = jacobian @ pose[:3, :3]
        flat = jacobian @ covariance @ jacobian.T
        blurred = flat + eps2d * torch.eye(2, dtype=pose.dtype)
        opacity = gaussians.opacities[index]
        if antialiased:
            share = torch.linalg.det(flat) / torch.linalg.det(blurred)
            opacity = opacity * torch.sqrt(share) if share > 0 else opacity * 0
        difference = pixels - torch.stack([fx * x / z + cx, fy * y / z + cy])
        distance = (difference @ torch.linalg.inv(blurred) * difference).sum(-1)
        alpha = (opacity * torch.exp(-0.5 * distance)).clamp_max(max_alpha)
        left = transmittance * (1 - alpha)
        counts = (alpha >= 1 / 255) & ~done
        done = done | (counts & (left <= 1e-4))
        counts = counts & ~done
        weight = torch.where(counts, alpha * transmittance, 0.0)
        picture = picture + weight[..., None] * torch.cat([gaussians.colors[index], z[None]])
        transmittance = torch.where(counts, left, transmittance)
    rgb = picture[..., :-1] + transmittance[..., None] * background
    return rgb, 1 - transmittance, picture[..., -1]
