"""The default head: MakeHuman's CC0 base mesh, 52 ARKit shapes and identity, packed in one file."""

from meshanim.heads.default.head import DefaultHead, HeadPart, load_default_head

__all__ = ["DefaultHead", "HeadPart", "load_default_head"]
