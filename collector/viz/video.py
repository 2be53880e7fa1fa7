"""Videos of executed interactions: the whole object, the touched point from near, and what happened in words."""

import io
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import matplotlib
import numpy as np
from PIL import Image, ImageDraw, ImageFont

from collector.viz.playback import Playback
from collector.viz.rendering import Picture, Renderer, View, fitted, with_most_of_the_hand
from shared.errors import UsageError
from shared.extras import require_packages
from shared.io.files import write_atomically, writing
from shared.io.text import plain
from shared.plan import InteractionRecord, RolloutRecord

SUFFIXES = (".mp4", ".gif", ".png")
FRAMES_A_SECOND = 25
"""4 hundredths of a second each, which is how GIF counts."""
WIDTH, HEIGHT = 854, 480
CLOSE_UP = 320
"""Width and height of the picture of the touched point, pixels, and width of the caption below it."""
FIELD_OF_VIEW_DEG = 30.0
CLOSE_UP_DISTANCE, CLOSE_UP_DEG = 5.0, 6.5
"""So that 0.57 m are seen across."""
SIDES_DEG, ELEVATION_DEG = (-50.0, 50.0), 25.0
PAUSE_S = 0.6
"""How long the end is shown."""
LINES, LONGEST = 7, 36
INK, GREEN, RED = (30, 30, 30), (0, 120, 50), (190, 30, 30)
QUALITY = {"crf": "20", "preset": "medium"}
"""Of x264."""


@dataclass(frozen=True, slots=True)
class Clip:
    """One interaction.

    Attributes:
        playback: its frames, `FRAMES_A_SECOND`.
        lines: its caption; the first is the title, the second how it ended.
        success: of the stored outcome.
    """

    playback: Playback
    lines: tuple[str, ...]
    success: bool

    @classmethod
    def of(cls, playback: Playback, rollout: RolloutRecord, row: InteractionRecord) -> "Clip":
        """The clip of a stored interaction; its caption has the stored outcome."""
        outcome, again = row.outcome, playback.outcome
        part = playback.target.bodies[row.target_part]
        unit = "rad" if part.joint is not None and part.joint.kind == "revolute" else "m"
        ref = rollout.object
        lines = [
            ref.id if ref.category.lower() in ref.id.lower() else f"{ref.category} {ref.id}",
            f"{'success' if outcome.success else 'failure'} ({outcome.kind}), moved {outcome.motion:.3f} {unit}",
            f"{row.primitive}, part {row.target_part} {part.part_name}",
            f"proposed by {row.proposer}" + (f", policy {row.policy_version}" if row.policy_version else ""),
            f"{rollout.plan_key}, rollout {rollout.index}, step {row.step}",
        ]
        if again.success is not outcome.success:
            lines.append(f"executed again: {'success' if again.success else 'failure'} ({again.kind})")
        return cls(playback, tuple(plain(line) for line in lines), outcome.success)

    def __len__(self) -> int:
        """How many frames it has with the pause at its end."""
        return len(self.playback.times) + round(PAUSE_S * FRAMES_A_SECOND)

    def pictures(self, frames: Sequence[int]) -> Iterator[Picture]:
        """The pictures of some frames; whatever is after the end shows the end."""
        playback, width = self.playback, WIDTH - CLOSE_UP
        places = [playback.seen_from(side, ELEVATION_DEG, CLOSE_UP_DISTANCE) for side in SIDES_DEG]
        place = with_most_of_the_hand(playback, places, CLOSE_UP_DEG)
        whole = Renderer(playback, fitted(playback, View(place, width, HEIGHT, FIELD_OF_VIEW_DEG)))
        near = Renderer(playback, View(place, CLOSE_UP, CLOSE_UP, CLOSE_UP_DEG))
        last, drawn = len(playback.times) - 1, -1
        picture = np.full((HEIGHT, WIDTH, 3), 255, np.uint8)
        for frame in (min(frame, last) for frame in frames):
            if frame != drawn:
                picture[:, :width] = whole.picture(frame)
                picture[:CLOSE_UP, width:] = near.picture(frame)
                picture[CLOSE_UP:, width:] = self._caption(float(playback.times[frame]))
                picture[:CLOSE_UP, width] = picture[CLOSE_UP - 1, width:] = 160
                drawn = frame
            yield picture.copy()

    def _caption(self, time_s: float) -> Picture:
        image = Image.new("RGB", (CLOSE_UP, HEIGHT - CLOSE_UP), "white")
        draw, step = ImageDraw.Draw(image), (HEIGHT - CLOSE_UP) / LINES
        fonts = Path(matplotlib.get_data_path(), "fonts/ttf")
        usual, bold = (ImageFont.truetype(fonts / f"DejaVuSans{kind}.ttf", round(0.6 * step)) for kind in ("", "-Bold"))
        for number, line in enumerate((*self.lines, f"{time_s:.2f} s")):
            short = line if len(line) <= LONGEST else line[: LONGEST - 1] + "…"
            colour = (GREEN if self.success else RED) if number == 1 else INK
            draw.text((8, number * step + 4), short, colour, bold if number == 0 else usual)
        return np.asarray(image)


def check_video(out: Path) -> None:
    """Check whether a video can be written, before the work starts.

    Raises:
        UsageError: no such format, or a package is missing.
    """
    if out.suffix.lower() not in SUFFIXES:
        raise UsageError(f"{out}: no video; its name must end in {', '.join(SUFFIXES)} (three moments side by side)")
    if out.is_dir():
        raise UsageError(f"{out}: is a folder; name a file")
    require_packages("a video", "matplotlib", *(["av"] if out.suffix.lower() == ".mp4" else []))


def write_video(clips: Sequence[Clip], out: Path, advance: Callable[[], None] = lambda: None) -> None:
    """Write interactions one after the other; the file is there when all of it is.

    Args:
        clips: at least one.
        out: .mp4, .gif, or .png, which shows the moments of the first clip one above the other.
        advance: called after each frame.

    Raises:
        UsageError: see `check_video`; or the file cannot be written.
    """
    check_video(out)

    def counted(pictures: Iterator[Picture]) -> Iterator[Picture]:
        for picture in pictures:
            yield picture
            advance()

    file = io.BytesIO()
    if out.suffix.lower() == ".png":
        pictures = counted(clips[0].pictures(list(clips[0].playback.moments.values())))
        Image.fromarray(np.concatenate(list(pictures))).save(file, "png")
    else:
        write = _write_mp4 if out.suffix.lower() == ".mp4" else _write_gif
        write(counted(picture for clip in clips for picture in clip.pictures(range(len(clip)))), file)
    with writing(out, "name a file that can"):
        out.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(out, file.getvalue())


def _write_mp4(pictures: Iterator[Picture], file: io.BytesIO) -> None:
    import av

    with av.open(file, "w", format="mp4") as container:
        stream = container.add_stream("libx264", rate=FRAMES_A_SECOND, options=QUALITY)
        stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, "yuv420p"
        for picture in pictures:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
        container.mux(stream.encode(None))


def _write_gif(pictures: Iterator[Picture], file: io.BytesIO) -> None:
    """All frames have one palette, that of the first, so that colours do not flicker."""
    first = Image.fromarray(next(pictures))
    palette = first.quantize(dither=Image.Dither.NONE)

    def reduced(picture: Picture) -> Image.Image:
        return Image.fromarray(picture).quantize(palette=palette, dither=Image.Dither.NONE)

    palette.save(
        file,
        "gif",
        save_all=True,
        append_images=(reduced(picture) for picture in pictures),
        duration=1000 // FRAMES_A_SECOND,
        loop=0,
    )
