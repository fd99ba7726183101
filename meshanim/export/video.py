"""Frames and sound to a video file, and frames to a contact sheet."""

from collections.abc import Iterable, Sequence
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
from jaxtyping import UInt8
from PIL import Image, ImageDraw

from meshanim.audio import Waveform
from meshanim.errors import OptionError, ShapeError
from meshanim.files import written_whole

__all__ = ["contact_sheet", "write_png", "write_video"]

Frame = UInt8[np.ndarray, "height width 3"]


def write_video(
    path: str | Path, frames: Iterable[Frame], fps: float, audio: Waveform | None = None, crf: int = 18
) -> int:
    """Encode H.264 (and AAC, where there is sound) into an mp4 that plays in browsers.

    Parameters
    ----------
    path : str or Path
        Written whole: nothing appears under this name until the last frame is in.
    frames : iterable of (H, W, 3) uint8
        sRGB; taken one at a time, so that length costs no memory. Height and width must be even.
    fps : float
        Frames a second.
    audio : Waveform, optional
        Sound that starts with the first frame.
    crf : int
        Quality of H.264, 0 (lossless) to 51; 18 is visually lossless.

    Returns
    -------
    int
        Frames written.

    Raises
    ------
    ShapeError
        If there is no frame, or a frame has another size than the first or an odd one.
    OptionError
        If `fps` or `crf` is out of range.
    """
    if not fps > 0 or not 0 <= crf <= 51:
        raise OptionError(f"fps must be positive and crf in 0..51, not {fps} and {crf}")
    written, sound_sent = 0, 0
    rate = Fraction(fps).limit_denominator(1001)
    with (
        written_whole(path) as temporary,
        av.open(str(temporary), "w", options={"movflags": "+faststart"}) as file,
    ):
        video = file.add_stream("libx264", rate=rate, options={"crf": str(crf), "preset": "medium"})
        sound = None if audio is None else file.add_stream("aac", rate=audio.rate, layout="mono")
        for image in frames:
            if written == 0:
                video.height, video.width = image.shape[:2]
                video.pix_fmt = "yuv420p"
                _check_even(image)
            elif image.shape[:2] != (video.height, video.width):
                raise ShapeError(
                    f"frame {written} is {image.shape[:2]}, the first {video.height, video.width}"
                )
            frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(image), format="rgb24")
            file.mux(video.encode(frame))
            written += 1
            if audio is not None:  # keep sound and picture interleaved
                end = min(len(audio.samples), int(written / rate * audio.rate))
                file.mux(_encode_sound(sound, audio, sound_sent, end))
                sound_sent = end
        if written == 0:
            raise ShapeError("a video needs at least one frame")
        if audio is not None and sound is not None:
            file.mux(sound.encode(None))
        file.mux(video.encode(None))
    return written


def _check_even(image: np.ndarray) -> None:
    if image.shape[0] % 2 or image.shape[1] % 2:
        raise ShapeError(f"H.264 needs even sizes, not {image.shape[1]} x {image.shape[0]}")


def _encode_sound(stream, audio: Waveform, start: int, end: int) -> list:
    if end <= start:
        return []
    samples = np.ascontiguousarray(audio.samples[None, start:end], np.float32)
    frame = av.AudioFrame.from_ndarray(samples, format="fltp", layout="mono")
    frame.sample_rate = audio.rate
    frame.pts = start
    frame.time_base = Fraction(1, audio.rate)
    return stream.encode(frame)


def contact_sheet(
    frames: Sequence[Frame], columns: int, labels: Sequence[str] | None = None
) -> UInt8[np.ndarray, "sheet_height sheet_width 3"]:
    """Lay frames of one size out in rows, each with its label in the upper left corner.

    Parameters
    ----------
    frames : sequence of (H, W, 3) uint8
    columns : int
        Frames a row; the last row is filled up with grey.
    labels : sequence of str, optional
        One a frame.
    """
    if not frames:
        raise ShapeError("a contact sheet needs at least one frame")
    height, width = frames[0].shape[:2]
    rows = -(-len(frames) // columns)
    sheet = Image.new("RGB", (columns * width, rows * height), (96, 96, 96))
    draw = ImageDraw.Draw(sheet)
    for index, frame in enumerate(frames):
        x, y = index % columns * width, index // columns * height
        sheet.paste(Image.fromarray(frame), (x, y))
        if labels is not None:
            draw.text(
                (x + 6, y + 4), labels[index], fill=(255, 255, 255), stroke_width=1, stroke_fill=(0, 0, 0)
            )
    return np.asarray(sheet)


def write_png(path: str | Path, image: Frame) -> None:
    """Write one image whole; the format follows the ending (png, jpg)."""
    with written_whole(path) as temporary:
        Image.fromarray(image).save(temporary, quality=90)
