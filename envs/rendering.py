"""Pictures of a system: a scene in metres, and beside it what the agent sees and what is hidden from it.

A system draws itself on a `Canvas` in its own units; everything is drawn at twice the size and scaled down, which
smooths the edges. The colours are a colour-blind safe set (Okabe and Ito).
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from functools import cache
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from beliefgym.envs.system import System

os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")

SIZE = 480  # side of the scene in pixels
PANEL = 240  # width of the panel in pixels
_SCALE = 2
COLORS = {
    "background": (250, 250, 248),
    "panel": (238, 239, 236),
    "guide": (205, 207, 203),
    "body": (0, 114, 178),
    "far": (135, 183, 211),
    "joint": (60, 64, 67),
    "force": (213, 94, 0),
    "target": (0, 158, 115),
    "text": (40, 42, 45),
    "faint": (160, 163, 160),
}
Point = tuple[float, float]


class Canvas:
    """A surface in world coordinates: metres, y upwards.

    Args:
        width: pixels. height: pixels.
    """

    def __init__(self, width: int, height: int) -> None:
        import pygame

        self._pygame = pygame
        self._size = (width * _SCALE, height * _SCALE)
        self.surface = pygame.Surface(self._size)
        self.surface.fill(COLORS["background"])
        self.view((0.0, 0.0), height=2.0)

    def view(self, center: Point, height: float | None = None, width: float | None = None) -> None:
        """Show a window of the world of this height or width in m around a centre."""
        if (height is None) == (width is None):
            raise ValueError("expected either height or width of the view in m")
        self._pixels = self._size[1] / height if height is not None else self._size[0] / (width or 1.0)
        self._center = center

    def _at(self, point: Point) -> Point:
        x = self._size[0] / 2 + (point[0] - self._center[0]) * self._pixels
        y = self._size[1] / 2 - (point[1] - self._center[1]) * self._pixels
        return x, y

    def line(self, start: Point, end: Point, width: float, color: str) -> None:
        """A straight line of a width in m."""
        self._polygon(_thick(start, end, width), color)

    def rod(self, start: Point, end: Point, width: float, color: str) -> None:
        """A line with round ends."""
        self.line(start, end, width, color)
        for point in (start, end):
            self.circle(point, width / 2, color)

    def circle(self, center: Point, radius: float, color: str, width: float = 0.0) -> None:
        """A disc, or a ring of a width in m."""
        pixels = max(1, round(width * self._pixels)) if width else 0
        self._pygame.draw.circle(self.surface, COLORS[color], self._at(center), radius * self._pixels, pixels)

    def box(self, center: Point, width: float, height: float, color: str) -> None:
        """An upright rectangle with rounded corners."""
        left, top = self._at((center[0] - width / 2, center[1] + height / 2))
        rectangle = self._pygame.Rect(left, top, width * self._pixels, height * self._pixels)
        radius = round(0.18 * height * self._pixels)
        self._pygame.draw.rect(self.surface, COLORS[color], rectangle, border_radius=radius)

    def arrow(self, start: Point, end: Point, width: float, color: str) -> None:
        """An arrow; nothing where it is shorter than its own width."""
        vector = np.subtract(end, start)
        length = float(np.hypot(*vector))
        if length < width:
            return
        head = min(3.0 * width, length)
        neck = tuple(np.asarray(end) - vector * (head / length))
        self.line(start, (float(neck[0]), float(neck[1])), width, color)
        self._head((float(neck[0]), float(neck[1])), end, 2.6 * width, color)

    def turn_arrow(self, center: Point, radius: float, turn: float, color: str) -> None:
        """An arc with a head for a torque; turn in -1..1, positive clockwise, 1 is three quarters of a circle."""
        if abs(turn) < 0.02:
            return
        angles = np.linspace(0.0, turn * 1.5 * np.pi, 48)
        arc = [(center[0] + radius * np.sin(a), center[1] + radius * np.cos(a)) for a in angles]
        for start, end in pairwise(arc):
            self.rod(start, end, 0.12 * radius, color)
        tangent = np.sign(turn) * np.array([np.cos(angles[-1]), -np.sin(angles[-1])])
        tip = np.asarray(arc[-1]) + 0.42 * radius * tangent
        self._head(arc[-1], (float(tip[0]), float(tip[1])), 0.5 * radius, color)

    def _head(self, base: Point, tip: Point, width: float, color: str) -> None:
        left, right = _thick(base, tip, width)[:2]
        self._polygon([left, right, tip], color)

    def _polygon(self, points: Sequence[Point], color: str) -> None:
        self._pygame.draw.polygon(self.surface, COLORS[color], [self._at(point) for point in points])

    def image(self) -> NDArray[np.uint8]:
        """(height, width, 3)."""
        width, height = (side // _SCALE for side in self._size)
        small = self._pygame.transform.smoothscale(self.surface, (width, height))
        return np.ascontiguousarray(self._pygame.surfarray.array3d(small).transpose(1, 0, 2))


def _thick(start: Point, end: Point, width: float) -> list[Point]:
    """The four corners of a line with a width; the first two lie at its start."""
    direction = np.subtract(end, start)
    across = np.array([-direction[1], direction[0]]) * (0.5 * width / (np.hypot(*direction) or 1.0))
    corners = (start + across, start - across, end - across, end + across)
    return [(float(x), float(y)) for x, y in corners]


def picture(
    system: System,
    state: NDArray[np.float64],
    action: NDArray[np.float64] | None,
    shown: Sequence[str],
) -> NDArray[np.uint8]:
    """The scene and the panel.

    Args:
        system: what is drawn.
        state: (n_state,).
        action: (n_action,) last action, or None.
        shown: names of the observation components that the agent sees; the others are marked hidden.

    Returns:
        (480, 720, 3) uint8.
    """
    canvas = Canvas(SIZE, SIZE)
    system.draw(canvas, state, action)
    return np.concatenate([canvas.image(), _panel(system, state, action, shown)], axis=1)


def _panel(
    system: System, state: NDArray[np.float64], action: NDArray[np.float64] | None, shown: Sequence[str]
) -> NDArray[np.uint8]:
    """Names and values: of the observation (hidden components faint and without value), and of the action."""
    values = np.asarray(system.observe(state))
    seen = [
        (name, f"{value:.2f}" if name in shown else "hidden", "text" if name in shown else "faint")
        for name, value in zip(system.observation_names, values, strict=True)
    ]
    done = [
        (name, "-" if action is None else f"{action[i]:.2f}", "force")
        for i, name in enumerate(system.action_names)
    ]
    return panel(type(system).__name__, seen, done)


def panel(
    title: str, seen: Sequence[tuple[str, str, str]], done: Sequence[tuple[str, str, str]]
) -> NDArray[np.uint8]:
    """The side panel: rows (name, value, color) of the observation and of the action, as small as they must be.

    Returns:
        (480, 240, 3) uint8.
    """
    import pygame

    surface = pygame.Surface((PANEL, SIZE))
    surface.fill(COLORS["panel"])
    y = _text(surface, title, 16, 18, 22, "text")
    rows = len(seen) + len(done)
    pitch = min(21.0, (SIZE - y - 90.0) / max(rows, 1))
    size = max(6, round(0.8 * pitch))
    for heading, lines in (("the agent sees", seen), ("action", done)):
        y = _text(surface, heading, 16, y + 14, 15, "faint") + 4
        top = float(y)
        for name, value, color in lines:
            _text(surface, value, PANEL - 70, round(top), size, color)
            _text(surface, name.replace("_", " "), 16, round(top), size, color)
            top += pitch
        y = round(top)
    return np.ascontiguousarray(pygame.surfarray.array3d(surface).transpose(1, 0, 2))


@cache
def _font(size: int) -> Any:
    import pygame

    pygame.font.init()
    return pygame.font.Font(None, size + 6)


def _text(surface: Any, text: str, x: int, y: int, size: int, color: str) -> int:
    """Write a line; returns the y below it."""
    line = _font(size).render(text, True, COLORS[color])
    surface.blit(line, (x, y))
    return int(y + line.get_height())


class Window:
    """A window on the screen.

    Args:
        title: its title.
    """

    def __init__(self, title: str) -> None:
        import pygame

        self._pygame = pygame
        pygame.display.init()
        self._screen = pygame.display.set_mode((SIZE + PANEL, SIZE))
        pygame.display.set_caption(f"beliefgym: {title}")
        self._clock = pygame.time.Clock()

    def show(self, frame: NDArray[np.uint8], fps: int) -> None:
        """Show a frame and wait for its time."""
        self._pygame.surfarray.blit_array(self._screen, frame.transpose(1, 0, 2))
        self._pygame.event.pump()
        self._pygame.display.flip()
        self._clock.tick(fps)

    def close(self) -> None:
        """Close it."""
        self._pygame.display.quit()
