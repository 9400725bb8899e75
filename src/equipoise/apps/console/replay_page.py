"""Page of a replay: a run's log in 3-D, with gauges, plots, a time line, its events, and films.

All browsers see the same position. Whatever a browser asks is done by the one thread of `play`.
"""

import time
from collections.abc import Callable
from functools import partial
from importlib import resources
from importlib.util import find_spec
from math import isfinite, pi
from queue import Empty, SimpleQueue
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from equipoise.apps.console.film_export import FilmExport
from equipoise.apps.console.gauges import gauges, phase_colour, shown, state_card
from equipoise.apps.console.playback import SPEEDS, Playback
from equipoise.apps.console.plots import Curve, cursor, plots
from equipoise.apps.console.replayed_run import Mark, ReplayedRun, RunPose
from equipoise.apps.console.scene import VIEWS, RigView
from equipoise.apps.console.web import serving
from equipoise.apps.report.pictures import MP4, WEBP, check_length
from equipoise.apps.report.style import BLUE, GREEN, INK, PURPLE, VERMILION, typeset
from equipoise.control.states import Phase
from equipoise.errors import InputError
from equipoise.logs.run_log import RunLog
from equipoise.printable import printable

if TYPE_CHECKING:
    import viser

PERIOD: Final = 0.04
"""Time between two pictures [s]."""
PANEL_WIDTH: Final = 380.0
"""Width of the panel beside the scene [px]."""
PLAY, PAUSE = "Play", "Pause"
TO_START, BACK, FORWARD, TO_END = STEPS = ("start", "−1 tick", "+1 tick", "end")
"""Buttons that step."""
MAKE, CANCEL = "Make a film of the shown part", "Cancel"
FONT: Final = "font:13px/1.4 system-ui,sans-serif;padding:2px 9px;overflow-wrap:anywhere"
SIMULATED: Final = "simulation"
"""Name of the state of a simulated run, which has no phases."""
RESOLUTION: Final = 0.01
"""Resolution of the sliders [s]."""


def show_run(
    run: RunLog,
    title: str,
    address: str,
    port: int,
    ready: Callable[[str], None],
    stopped: Callable[[], bool],
) -> None:
    """Serve the replay of a run until stopped.

    Args:
        run: The run.
        title: Name of the log.
        address: Address of this computer to listen on.
        port: Port; 0 selects a free one.
        ready: Receives the address of the page with its token.
        stopped: Returns whether to end; called for each picture.

    Raises:
        MissingExtraError: viser is not installed.
        InputError: The address is invalid.
        OutsideError: The port is not available.
        RecordingError: The log has nothing to show.
    """
    replayed = ReplayedRun.of(run)
    page: ReplayPage | None = None

    def ask(name: str) -> str:
        if page is not None:
            page.ask(name)
        return ""

    actions = {f"/{name}": partial(ask, name) for name in ("toggle", "back", "forward")}
    overlay = resources.files("equipoise.apps.console").joinpath("replay.html").read_bytes()
    with serving(address, port, actions=actions, overlay=overlay) as (server, url):
        page = ReplayPage(server, run, replayed, title)
        ready(url)
        page.play(stopped)


class ReplayPage:
    """Content of all browsers."""

    def __init__(
        self, server: "viser.ViserServer", run: RunLog, replayed: ReplayedRun, title: str
    ) -> None:
        """Fill a server's page; nothing plays before `play` is called.

        Args:
            server: The viser server.
            run: The run.
            replayed: The same run at its ticks.
            title: Name of the log.
        """
        self._server, self._run, self._replayed, self._title = server, run, replayed, title
        self._playback = Playback(replayed.time, replayed.whole, replayed.usual)
        self._asked: SimpleQueue[Callable[[], None]] = SimpleQueue()
        self._film: FilmExport | None = None
        self._mark: Mark | None = None
        server.gui.configure_theme(show_logo=False, show_share_button=False)
        server.gui.set_panel_label("Replay of a run")
        server.gui.main_panel.dock_right()
        server.gui.main_panel.set_width(PANEL_WIDTH)
        server.scene.configure_environment_map("studio", environment_intensity=0.5)
        self._view = RigView(server, run.conditions.arm)
        self._add_time_line()
        tabs = server.gui.add_tab_group()
        with tabs.add_tab("Plots"):
            self._add_plots()
        with tabs.add_tab("Events"):
            self._add_events()
        with tabs.add_tab("Film"):
            self._add_film()
        server.on_client_connect(self._connect)
        self._show_part()
        self._show()

    def _connect(self, client: "viser.ClientHandle") -> None:
        self._view.keep_in_view(client)
        client.camera.on_update(lambda _: self._view.keep_in_view(client))

    def ask(self, name: str) -> None:
        """Do at the next picture what a key asks for: `toggle`, `back` or `forward`."""
        todo = {
            "toggle": self._toggle,
            "back": partial(self._step, BACK),
            "forward": partial(self._step, FORWARD),
        }
        self._asked.put(todo[name])

    def play(self, stopped: Callable[[], bool]) -> None:
        """Do what the browsers ask, and show the run, until stopped."""
        last = time.monotonic()
        try:
            while not stopped():
                changed = self._do_what_is_asked(until=last + PERIOD)
                now = time.monotonic()
                if self._playback.playing or changed:
                    self._playback.advance(now - last)
                    self._show()
                last = now
                self._show_film()
        finally:
            if self._film is not None:
                self._film.cancel()

    def _do_what_is_asked(self, until: float) -> bool:
        """Return whether something was done."""
        changed = False
        while True:
            try:
                todo = self._asked.get(timeout=max(until - time.monotonic(), 0.0))
            except Empty:
                return changed
            todo()
            changed = True
            if time.monotonic() >= until:
                return True

    # The time line.

    def _add_time_line(self) -> None:
        gui, (begin, end) = self._server.gui, map(_round, self._replayed.whole)
        ends: Any = {"min": begin, "max": max(end, begin + RESOLUTION), "step": RESOLUTION}
        self._state = gui.add_html("")
        self._gauges = gui.add_html("")
        self._slider = gui.add_slider("time [s]", initial_value=begin, **ends)
        self._slider.on_update(self._from_browser(self._drag))
        self._button = gui.add_button(PLAY, color="blue", hint="or the space bar")
        self._button.on_click(self._from_browser(self._toggle))
        steps = gui.add_button_group("step", STEPS, hint="or the keys , and .")
        steps.on_click(lambda event: self._asked.put(partial(self._step, event.target.value)))
        self._speed = gui.add_dropdown("speed", tuple(SPEEDS), initial_value="1×")
        self._speed.on_update(self._from_browser(self._set_speed))
        view = gui.add_button_group("view", VIEWS, hint="or turn the view with the mouse")
        view.on_click(self._turn)
        self._part = gui.add_multi_slider(
            "shown [s]",
            initial_value=(begin, end),
            **ends,
            hint="start and end of what is played, plotted and filmed",
        )
        self._part.on_update(self._from_browser(self._choose_part))

    def _from_browser(self, todo: Callable[[], None]) -> Callable[[Any], None]:
        """Return a callback that asks for `todo`, if a browser caused the event."""

        def callback(event: Any) -> None:
            if event.client_id is not None:
                self._asked.put(todo)

        return callback

    def _toggle(self) -> None:
        if self._playback.playing:
            self._playback.pause()
        else:
            self._playback.play()

    def _drag(self) -> None:
        self._playback.pause()
        self._jump(float(self._slider.value))

    def _step(self, name: str) -> None:
        playback = self._playback
        if name in (BACK, FORWARD):
            playback.step(-1 if name == BACK else 1)
            self._show_part_of_jump()
        else:
            playback.pause()
            self._jump(playback.begin if name == TO_START else playback.end)

    def _jump(self, moment: float) -> None:
        self._playback.jump(moment)
        self._show_part_of_jump()

    def _set_speed(self) -> None:
        self._playback.speed = SPEEDS[self._speed.value]

    def _turn(self, event: Any) -> None:
        if event.client is not None:
            self._view.look_from(event.client, event.target.value)

    def _choose_part(self) -> None:
        begin, end = self._part.value
        self._playback.show(float(begin), float(end))
        self._show_part()

    def _show_part_of_jump(self) -> None:
        """Show the plots of a part that became longer by a jump."""
        if self._shown_part != (self._playback.begin, self._playback.end):
            self._show_part()

    def _show_part(self) -> None:
        part = self._shown_part = self._playback.begin, self._playback.end
        rounded: Any = tuple(map(_round, part))
        self._part.value = rounded
        marks = {mark.time: False for mark in self._replayed.marks}
        marks |= {mark.time: True for mark in self._replayed.marks if mark.cause}
        self._plots.content = plots(self._replayed.time, self._curves, part, marks)

    # What the run looks like.

    def _show(self) -> None:
        """Show the run at the position."""
        playback = self._playback
        now = self._replayed.at(playback.time)
        with self._server.atomic():
            phi = now.phi if isfinite(now.phi) else pi
            self._view.show(now.q, phi, commanded=now.commanded, u=now.u)
            self._gauges.content = gauges(now.phi, now.x)
            self._cursor.content = cursor(playback.time, (playback.begin, playback.end))
            self._slider.value = _round(playback.time)
            self._state.content = self._card(now)
            label = PAUSE if playback.playing else PLAY
            if self._button.label != label:
                self._button.label = label

    def _card(self, now: RunPose) -> str:
        run, conditions = self._run, self._run.conditions
        late = f", late by {1e3 * max(now.late, 0.0):.2f} ms" if isfinite(now.late) else ""
        lines = (
            typeset(f"t = {self._playback.time:.3f} s, u = {now.u:+.2f} m/s²{late}"),
            f"{self._title}: {conditions.arm.name}, {conditions.world}; ended: {run.cause}",
            *filter(None, [run.damage]),
        )
        known = {phase.value: phase for phase in Phase}
        name = now.phase or SIMULATED
        colour = phase_colour(known.get(now.phase)) if now.phase else BLUE
        return state_card(name, colour, lines)

    def _add_plots(self) -> None:
        replayed = self._replayed
        curves = {
            "φ [deg]": (BLUE, np.degrees(replayed.phi)),
            "x [mm]": (GREEN, 1e3 * replayed.x),
            "u [m/s²]": (PURPLE, replayed.u),
            "lateness of the ticks [ms]": (VERMILION, 1e3 * np.maximum(replayed.late, 0.0)),
        }
        self._curves = [
            Curve(title, *of)
            for title, of in curves.items()
            if replayed.phases or "late" not in title
        ]
        self._cursor = self._server.gui.add_html("")
        self._plots = self._server.gui.add_html("")

    # The events.

    def _add_events(self) -> None:
        gui = self._server.gui
        self._sentence = gui.add_html(_sentence("Jump to an event:"))
        for mark in self._replayed.marks:
            label = typeset(f"{mark.time:+.2f} s  ") + printable(mark.name)
            button = gui.add_button(label, color="red" if mark.cause else "gray")
            button.on_click(self._from_browser(partial(self._jump_to, mark)))

    def _jump_to(self, mark: Mark) -> None:
        self._playback.pause()
        self._jump(mark.time)
        kind = " (a cause of the end)" if mark.cause else ""
        text = f": {mark.text}" if mark.text else ""
        self._sentence.content = _sentence(f"{mark.name}{kind}{text}")

    # The film.

    def _add_film(self) -> None:
        gui = self._server.gui
        kinds = {"MP4 (H.264)": MP4} if find_spec("imageio_ffmpeg") else {}
        self._kinds = kinds | {"animated WebP": WEBP}
        self._kind = gui.add_dropdown("format", tuple(self._kinds))
        self._make = gui.add_button(MAKE, color="blue")
        self._make.on_click(self._from_browser(self._begin_or_cancel))
        self._progress = gui.add_progress_bar(0.0, visible=False)
        note = (
            "" if kinds else "An MP4 needs one more package: python -m pip install imageio-ffmpeg."
        )
        self._note = gui.add_html(_sentence(note), visible=bool(note))
        self._download = gui.add_button("Download", color="green", visible=False)
        self._download.on_click(self._send)

    def _begin_or_cancel(self) -> None:
        if self._film is not None and self._film.running:
            self._film.cancel()
            return
        playback, suffix = self._playback, self._kinds[self._kind.value]
        try:
            if suffix == WEBP:
                check_length(playback.end - playback.begin)
        except InputError as error:
            self._say_of_film(str(error))
            return
        self._film = FilmExport(self._run, self._title, playback.begin, playback.end, suffix)
        self._make.label, self._progress.visible = CANCEL, True
        self._download.visible = self._note.visible = False

    def _show_film(self) -> None:
        """Show how far the film is."""
        film = self._film
        if film is None or not self._progress.visible:
            return
        running = film.running  # before its result, which is complete then
        share = round(100.0 * film.share)
        if self._progress.value != share:
            self._progress.value = share
        if running:
            return
        self._make.label, self._progress.visible = MAKE, False
        if film.content is None:
            self._say_of_film(film.error or "the film could not be made; the terminal says why")
            return
        size = len(film.content) / 1e6
        self._download.label = f"Download {film.name} ({size:.1f} MB)"
        self._download.visible = True

    def _say_of_film(self, text: str) -> None:
        self._note.content, self._note.visible = _sentence(text), True

    def _send(self, event: Any) -> None:
        """Send the film to the browser that asked for it."""
        film = self._film
        if event.client is not None and film is not None and film.content is not None:
            event.client.send_file_download(film.name, film.content, save_immediately=True)


def _round(moment: float) -> float:
    """Return a time as sliders show it [s]."""
    return round(moment, 2)


def _sentence(text: str) -> str:
    return f'<div style="{FONT};color:{INK}">{shown(text)}</div>'
