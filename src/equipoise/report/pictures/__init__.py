"""Pictures of a run: the paper's figure 3 as a strip of frames, an animation, and a video.

MuJoCo draws the rig off-screen from recorded joint positions and angles.
"""

from equipoise.report.pictures.film import Animation, animation
from equipoise.report.pictures.strip import strip
from equipoise.report.pictures.video import find_encoder, write_video

__all__ = ["Animation", "animation", "find_encoder", "strip", "write_video"]
