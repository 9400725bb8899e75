"""Pictures of a run: the paper's figure 3 as a strip of frames, an animation, and a video.

MuJoCo draws the rig off-screen from recorded joint positions and angles.
"""

from equipoise.apps.report.pictures.film import Animation, animation, check_length
from equipoise.apps.report.pictures.moments import (
    Moments,
    check_span,
    moments,
    origin,
    span,
    whole_span,
)
from equipoise.apps.report.pictures.strip import strip
from equipoise.apps.report.pictures.video import MP4, SUFFIXES, WEBP, find_encoder, write_video

__all__ = [
    "MP4",
    "SUFFIXES",
    "WEBP",
    "Animation",
    "Moments",
    "animation",
    "check_length",
    "check_span",
    "find_encoder",
    "moments",
    "origin",
    "span",
    "strip",
    "whole_span",
    "write_video",
]
