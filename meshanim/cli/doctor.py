"""`meshanim doctor`: what is installed, which backends work, and how to get what is missing."""

__all__ = ["run"]


def run() -> int:
    try:
        from meshanim import _native

        print(f"native kernels: yes, on {_native.instruction_set()}")
    except ImportError:
        print("native kernels: no; pip install meshanim again with a C++17 compiler at hand")
    return 0
