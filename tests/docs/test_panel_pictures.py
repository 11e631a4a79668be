"""Where no browser is, the site is built all the same, and says that it has no pictures of the panel."""

from docs.generators import panel_pictures
from tests.support import browsers


def test_without_a_browser_the_page_says_so(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(browsers, "what_is_missing", lambda: "there is no Chromium")
    monkeypatch.setattr(panel_pictures, "THERE", tmp_path)
    (tmp_path / panel_pictures.FOLDER).mkdir()
    (tmp_path / panel_pictures.FOLDER / "old.png").touch()
    panel_pictures.write_pictures(tmp_path)
    assert "there is no Chromium" in capsys.readouterr().err
    assert not (tmp_path / panel_pictures.FOLDER).exists()
    assert "no pictures here" in panel_pictures.fragment()


def test_with_pictures_the_page_shows_each(tmp_path, monkeypatch):
    monkeypatch.setattr(panel_pictures, "THERE", tmp_path)
    (tmp_path / panel_pictures.FOLDER).mkdir()
    for name in panel_pictures.PICTURES:
        (tmp_path / panel_pictures.FOLDER / f"{name}.png").touch()
    shown = panel_pictures.fragment()
    assert all(f"(reference/panel/{name}.png)" in shown for name in panel_pictures.PICTURES)
