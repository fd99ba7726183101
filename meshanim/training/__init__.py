"""One trainer for all models: losses, metrics, checkpoints."""
