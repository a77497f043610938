"""Capture sets rendered by Mitsuba 3, a path tracer that nobody of this project wrote.

It needs the extra `render` (`pip install 'membrane_ctrl[render]'`) to render; what it rendered is
read without it. It shares no code with `membrane_ctrl`; the film's shape, the pictures of the
screen and the camera's counts are those of `tests.worlds.second_optics`.

A mirror behind a front film, four pictures of it, and a set on disk::

    bench = RenderedBench(Mirror(), front=FrontFilm(), resolution=0.125)
    truth = write_rendered_set(bench, tmp_path / "set", RenderSettings(samples=64), seed=1)

What is rendered: the mirror as a mesh with its normals, the front film as a thin dielectric sheet
with all its reflections, the gas inside with its own refractive index, the panel with its pixels
and the dark grid between them, a lens of finite aperture, the ring, and a lit room. What is added
to the rendered light: the panel's fall-off with the viewing angle, veiling glare, vignetting.

`python -m benchmarks.metrology.path_traced` renders the committed sets, the campaign, and a sphere
that shows the renderer's own error.
"""
