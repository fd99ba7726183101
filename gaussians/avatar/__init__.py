"""Avatars: Gaussians on a parametric head, fitted to pictures."""

from meshanim.gaussians.avatar.model import Avatar, AvatarConfig

__all__ = ["Avatar", "AvatarConfig"]
