"""Checkpoints of any network, by what their config holds."""

from pathlib import Path

from huggingface_hub import hf_hub_download
from huggingface_hub.errors import HfHubHTTPError, HFValidationError, LocalEntryNotFoundError

from meshanim.errors import FileFormatError
from meshanim.files import read_json
from meshanim.models.audio2face import Audio2FaceDiffusion, Audio2FaceRegression
from meshanim.models.checkpoint import CONFIG
from meshanim.models.gava import Gava

__all__ = ["load_network"]


def load_network(name: str | Path, device: str = "cpu") -> Gava | Audio2FaceRegression | Audio2FaceDiffusion:
    """The network of a folder or a repository of the Hugging Face hub, in eval mode.

    Parameters
    ----------
    name : str or Path
        A folder that `meshanim train` wrote (or model/ in it), or a repository.
    device : str
        Where it runs.

    Raises
    ------
    FileFormatError
        If it is missing or damaged.
    """
    path = Path(name)
    if not (path / CONFIG).exists() and (path / "model" / CONFIG).exists():
        path = path / "model"
    try:
        file = path / CONFIG if path.is_dir() else hf_hub_download(repo_id=str(name), filename=CONFIG)
        config = read_json(file)
        if not isinstance(config, dict):
            raise FileFormatError(f"{file} holds no config of a network")
        kind: type[Gava | Audio2FaceRegression | Audio2FaceDiffusion] = Gava
        if "identities" in config:
            kind = Audio2FaceDiffusion
        elif "implicit" in config:
            kind = Audio2FaceRegression
        return kind.from_pretrained(path if path.is_dir() else name).to(device).eval()
    except (HfHubHTTPError, LocalEntryNotFoundError, HFValidationError) as error:
        raise FileFormatError(
            f"no checkpoint {name}: neither a folder here nor a repository of the hub that can be reached"
        ) from error
