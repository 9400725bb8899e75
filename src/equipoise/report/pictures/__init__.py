"""Pictures of a run: the paper's figure 3 as a strip of frames, an animation, and a video.

The rig is drawn by MuJoCo, without a screen, from joint positions and angles that were recorded.
"""

from equipoise.report.pictures.film import Animation, animation
from equipoise.report.pictures.rendering import frames
from equipoise.report.pictures.strip import strip
from equipoise.report.pictures.video import find_encoder, write_video

__all__ = ["Animation", "animation", "find_encoder", "frames", "strip", "write_video"]
