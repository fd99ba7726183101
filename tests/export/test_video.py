import av
import numpy as np
import pytest

from meshanim.audio import Waveform
from meshanim.errors import FileFormatError, OptionError, ShapeError
from meshanim.export.video import contact_sheet, write_video


def ramp(frames, height=32, width=48):
    for index in range(frames):
        yield np.full((height, width, 3), index * 8, np.uint8)


def tone(seconds, rate=16000):
    time = np.arange(int(seconds * rate)) / rate
    return Waveform((0.3 * np.sin(2 * np.pi * 440 * time)).astype(np.float32), rate)


@pytest.mark.parametrize("fps", [25, 29.97, 30, 60])
def test_picture_and_sound_come_back_in_time(tmp_path, fps):
    path = tmp_path / "talk.mp4"
    assert write_video(path, ramp(30), fps, tone(30 / fps)) == 30
    with av.open(str(path)) as file:
        video, sound = file.streams.video[0], file.streams.audio[0]
        assert float(video.average_rate) == pytest.approx(fps, rel=1e-4)
        frames = [frame.to_ndarray(format="rgb24") for frame in file.decode(video)]
        assert [round(frame.mean() / 8) for frame in frames] == list(range(30))
        assert float(sound.duration * sound.time_base) == pytest.approx(30 / fps, abs=0.07)
    with av.open(str(path)) as file:
        samples = np.concatenate([frame.to_ndarray()[0] for frame in file.decode(audio=0)])
    spectrum = np.abs(np.fft.rfft(samples))
    assert np.argmax(spectrum) * 16000 / len(samples) == pytest.approx(440, abs=5)


def test_sound_longer_than_the_picture_is_cut_and_shorter_is_kept(tmp_path):
    for seconds in (0.2, 5.0):
        path = tmp_path / f"{seconds}.mp4"
        write_video(path, ramp(30), 30, tone(seconds))
        with av.open(str(path)) as file:
            sound = file.streams.audio[0]
            assert float(sound.duration * sound.time_base) == pytest.approx(min(seconds, 1.0), abs=0.07)


def test_bad_frames_are_named_and_leave_no_file(tmp_path):
    path = tmp_path / "talk.mp4"
    with pytest.raises(ShapeError, match="even"):
        write_video(path, ramp(2, height=31), 30)
    with pytest.raises(ShapeError, match="at least one"):
        write_video(path, [], 30)
    with pytest.raises(ShapeError, match="frame 2"):
        write_video(path, [*ramp(2), np.zeros((16, 16, 3), np.uint8)], 30)
    with pytest.raises(OptionError, match="fps"):
        write_video(path, ramp(2), 0)
    assert list(tmp_path.iterdir()) == []
    with pytest.raises(FileFormatError, match="nowhere"):
        write_video(tmp_path / "nowhere" / "talk.mp4", ramp(2), 30)


def test_contact_sheet_puts_frames_in_reading_order():
    sheet = contact_sheet(list(ramp(5)), columns=3)
    assert sheet.shape == (64, 144, 3)
    assert [sheet[y + 30, x + 40, 0] for y in (0, 32) for x in (0, 48, 96)] == [0, 8, 16, 24, 32, 96]
