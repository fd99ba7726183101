"""`meshanim serve`: speech in and animation out over a network."""

from meshanim.serve.grpc_service import serve_grpc

__all__ = ["COMMANDS"]

COMMANDS = {"grpc": serve_grpc}
