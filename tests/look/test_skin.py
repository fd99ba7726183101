import numpy as np
import pytest
from PIL import Image
from scipy.spatial import cKDTree

from meshanim.errors import FileFormatError
from meshanim.render.look import PersonParameters, make_appearance
from meshanim.render.look.paint import blob, smoothstep
from meshanim.render.look.regions import beard_mask, brow_curve, hairline
from meshanim.render.look.skin import paint_skin

PLAIN = PersonParameters(seed=4, hair="buzz", stubble=0.5, freckles=0.4)


def test_paint_does_not_show_the_seams_of_the_layout(assets):
    """Two texels of different islands that lie on the same spot of the skin have the same colour."""
    atlas = assets.atlas
    paint = paint_skin(atlas, PLAIN)
    albedo = paint.skin[atlas.active, :3]
    face, neck = np.flatnonzero(atlas.island == 0), np.flatnonzero(atlas.island == 4)
    distance, nearest = cKDTree(atlas.position[face]).query(atlas.position[neck])
    touching = distance < 7e-4
    assert touching.sum() > 20
    difference = np.abs(albedo[neck[touching]] - albedo[face[nearest[touching]]])
    assert np.median(difference) < 0.01
    assert difference.max() < 0.12  # texels are 2 mm here, stubble and hair edges are finer


def test_masks_are_mirror_images():
    points = np.random.default_rng(0).uniform(-150, 150, (4000, 3))
    mirrored = points * [-1, 1, 1]
    assert np.array_equal(blob(points, (20, 0, 50), (9, 8, 7)), blob(mirrored, (20, 0, 50), (9, 8, 7)))
    assert np.array_equal(hairline(points, 0.4, 0.8), hairline(mirrored, 0.4, 0.8))
    assert np.array_equal(beard_mask(points), beard_mask(mirrored))


def test_masks_lie_where_they_should():
    forehead, crown, chin, eye = ([0, 70, 60], [0, 140, -60], [0, -72, 55], [31, 33, 45])
    edge = hairline(np.array([forehead, crown, chin, eye], float))
    assert (edge[[0, 2, 3]] < 0).all()
    assert edge[1] > 10
    assert hairline(np.array([[0.0, 105, 40]]), 1.0) < hairline(np.array([[0.0, 105, 40]]), 0.0)
    beard = beard_mask(np.array([forehead, chin, eye], float))
    assert beard[1] > 0.8
    assert beard[0] < 0.01
    assert beard[2] < 0.01
    x, y = brow_curve(np.linspace(0, 1, 11))
    assert (np.diff(x) > 0).all()
    assert (y > 45).all()  # above the eye


def test_smoothstep_rises_or_falls():
    assert np.allclose(smoothstep(0, 2, np.array([-1, 0, 1, 2, 3])), [0, 0, 0.5, 1, 1])
    assert np.allclose(smoothstep(2, 0, np.array([-1, 0, 1, 2, 3])), [1, 1, 0.5, 0, 0])


def test_parameters_move_the_paint_the_way_they_say(assets):
    atlas = assets.atlas
    cheek = blob(atlas.position * 1000, (45, -2, 38), (8, 8, 12)) > 0.6

    def mean(**changes):
        plain = PersonParameters(**{"seed": 4, "hair": "none", "moles": 0, **changes})
        return paint_skin(atlas, plain).skin[atlas.active][cheek].mean(0)

    base = mean()
    assert (mean(tone=0.8)[:3] < base[:3]).all()
    flushed = mean(blush=1.0)
    assert flushed[1] / flushed[0] < base[1] / base[0]  # redder
    freckled = mean(freckles=1.0)
    assert (freckled[:3] < base[:3]).all()
    lips = atlas.masks["lips"] > 0.95
    front = lips & (atlas.island == 0)
    red = PersonParameters(seed=4, lip_color=(0.8, 0.1, 0.1), lip_amount=1.0)
    painted = paint_skin(atlas, red).skin[atlas.active][front]
    assert (painted[:, 0] > 4 * painted[:, 1]).all()


def test_a_skin_picture_replaces_the_albedo(head, assets, tmp_path):
    path = tmp_path / "skin.png"
    ramp = np.zeros((128, 128, 3), np.uint8)
    ramp[..., 0] = np.arange(128)[None] * 2
    ramp[..., 1] = np.arange(128)[:, None] * 2
    Image.fromarray(ramp).save(path)
    appearance = make_appearance(head, PLAIN, 256, assets, path)
    own = ~assets.tongue_atlas.active[assets.atlas.active]  # small textures: the tongue's padding is near
    albedo = appearance.skin[assets.atlas.active, :3] ** (1 / 2.2)
    expected = np.clip(assets.makehuman_uv[:, 0] * 128 - 0.5, 0, 127) * 2 / 255
    bright = own & (expected > 0.2)
    assert np.abs(albedo[:, 0] - expected)[bright].max() < 0.02
    expected = np.clip((1 - assets.makehuman_uv[:, 1]) * 128 - 0.5, 0, 127) * 2 / 255
    bright = own & (expected > 0.2)
    assert np.abs(albedo[:, 1] - expected)[bright].max() < 0.02


def test_bad_skin_pictures_are_refused(head, assets, tmp_path):
    with pytest.raises(FileFormatError, match="nowhere"):
        make_appearance(head, PLAIN, 256, assets, tmp_path / "nowhere.png")
    text = tmp_path / "text.png"
    text.write_text("not a picture")
    with pytest.raises(FileFormatError, match=r"text\.png"):
        make_appearance(head, PLAIN, 256, assets, text)
    wide = tmp_path / "wide.png"
    Image.new("RGB", (128, 64)).save(wide)
    with pytest.raises(FileFormatError, match="square"):
        make_appearance(head, PLAIN, 256, assets, wide)
