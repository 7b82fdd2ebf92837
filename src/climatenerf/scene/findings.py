"""What is odd about a capture: findings with a code, a sentence and a remedy."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import asdict, dataclass
from typing import Any, Literal

Severity = Literal["note", "warning", "error"]
"""A note reports what was done; a warning may spoil the result; an error ends what
needs the file that it names."""

CODES: dict[str, str] = {
    # Files of the capture.
    "photo-missing": "Photos that have poses are not on disk; they are left out.",
    "photo-without-pose": "Photos on disk have no pose; they are left out.",
    "photo-unlisted": "Photos are in none of the capture's lists of a split; they are left out.",
    "photo-alpha": "Photos have an alpha channel, which is ignored.",
    "photo-hdr": "Photos are HDR (HLG or PQ); they are tone-mapped to sRGB.",
    "photo-resized": "Photos differ in size from their cameras; the intrinsics are scaled.",
    "photo-exchanged": "Photos do not show what their points show in other photos.",
    "name-normalised": "Names in the pose files and on disk differ in their spelling; matched.",
    "name-ambiguous": "A name in the pose files matches several files on disk.",
    "file-missing": "A file that the capture names is not on disk.",
    "file-unread": "The capture names data that is not read.",
    "sidecar-partial": "Labels, masks or depths exist for some photos only.",
    "sidecar-unused": "Files of labels, masks or depths belong to no photo.",
    "sidecar-orientation": "Sidecars are assumed to match the photos as shown, not as stored.",
    "model-lines": "A COLMAP model lacks the features of images.",
    "model-parts": "COLMAP produced several unconnected models; the largest is used.",
    # Intrinsics.
    "intrinsics-fractions": "The intrinsics are fractions of the picture's size; converted.",
    "intrinsics-resolution": "The intrinsics belong to pictures of another size; scaled.",
    "focal-negative": "A focal length is negative; its absolute value is used.",
    "focal-unusual": "A focal length is unusual for its picture, or fx and fy differ much.",
    "focal-disagrees": "Matches between photos agree with another focal length.",
    "focal-exif": "The focal length disagrees with that in the photos' EXIF records.",
    "principal-point": "The principal point is far from the middle of the picture.",
    "distortion-disagrees": "Photos show their points without the given lens distortion.",
    "distortion-fold": "The lens distortion cannot be inverted everywhere in the picture.",
    # Poses.
    "pose-outlier": "A camera is very far from the others; it is left out.",
    "pose-duplicate": "Several photos have the same pose.",
    "pose-no-baseline": "All cameras are at one position, so depth cannot be found.",
    "pose-axes": "The poses have the axes of another convention; converted.",
    "pose-disagrees": "The pose of a photo contradicts its own points, or its matches with others.",
    "matches-few": "Too few matches between photos to check the poses.",
    "matches-disagree": "Matches between neighbouring photos contradict their poses.",
    # Points.
    "points-missing": "Images of a COLMAP model show points that it lacks.",
    "points-outside": "Most sparse points lie in no picture.",
    "points-disagree": "Photos do not look alike where the sparse points lie in them.",
    "points-frame": "The sparse points are in another frame than the poses; transformed.",
    # Depths, masks, labels.
    "depth-empty": "Depth files hold no known depth.",
    "depth-saturated": "Depths at the largest value of the file format are taken as unknown.",
    "depth-unit": "The unit of the depth files disagrees with the poses.",
    "depth-ray-length": "The depth files hold lengths along rays instead of z-depths.",
    "depth-inverse": "The depth files hold inverse depths.",
    "depth-disagrees": "The depth files disagree with the sparse points.",
    "mask-hides-all": "Masks hide all of their photos.",
    "mask-hides-nothing": "Masks hide nothing.",
    "mask-inverted": "Masks hide what the capture's points were found on.",
    "labels-empty": "Label files hold no known class.",
    "labels-foreign": "Label files hold ids that their numbering does not define.",
    "labels-disagree": "Labels contradict the sparse points, up or each other.",
    # World frame and scale.
    "ground-missing": "No ground was found below the cameras; its height is assumed.",
    "origin-moved": "The world's origin is moved near the cameras.",
    "up-uncertain": "The methods that find up disagree.",
    "scale-assumed": "The scale is assumed, since nothing gives it.",
    "scale-disagrees": "Two pieces of evidence for the scale disagree.",
    "gps": "The GPS positions of the photos are unusable or imprecise.",
    # Others.
    "unreadable": "The capture cannot be used.",
    "earlier": "A warning that an earlier version saved.",
}
"""Meaning of every code; docs/guide/check.md lists them with remedies."""


@dataclass(frozen=True)
class Finding:
    """One odd thing about a capture.

    Attributes:
        code: Key of `CODES`.
        message: What is odd, without a full stop.
        remedy: What the user can do, without a full stop; empty if nothing needs doing, as for
            some notes.
        severity: "note", "warning" or "error".
        file: The file or folder it is about; `read_scene` puts the capture where it is empty.
    """

    code: str
    message: str
    remedy: str = ""
    severity: Severity = "warning"
    file: str = ""

    def __post_init__(self):
        if self.code not in CODES:
            raise ValueError(f"{self.code!r} is no code of a finding")

    def __str__(self) -> str:
        return f"{self.message}; {self.remedy}." if self.remedy else f"{self.message}."

    def as_json(self) -> dict[str, Any]:
        """Return the fields by name, the message with its full stop."""
        return {**asdict(self), "message": f"{self.message}."}


def finding_from_json(data: Any) -> Finding:
    """Return a finding from `as_json`'s fields, or from the sentence that earlier versions saved.

    Raises:
        ValueError: A field has the wrong type, or the severity is unknown.
    """
    if isinstance(data, str):
        return Finding("earlier", data.removesuffix("."))
    fields = {name: data[name] for name in ("code", "message", "remedy", "severity", "file")}
    if not all(isinstance(value, str) for value in fields.values()):
        raise ValueError("a finding has a field that is no text")
    if fields["severity"] not in ("note", "warning", "error"):
        raise ValueError(f"a finding has the severity {fields['severity']!r}")
    code = fields["code"] if fields["code"] in CODES else "earlier"  # of a newer version
    return Finding(**{**fields, "code": code, "message": fields["message"].removesuffix(".")})


def without_repeats(findings: Iterable[Finding]) -> tuple[Finding, ...]:
    """Return the findings in their order, each once."""
    return tuple(dict.fromkeys(findings))


def examples(names: list[str], count: int = 3) -> str:
    """Return the first of some names for a sentence: "a, b, c and 4 more"."""
    listed, rest = ", ".join(names[:count]), len(names) - count
    return f"{listed} and {rest} more" if rest > 0 else listed


def counted(count: int, noun: str) -> str:
    """Return a number with its noun: "1 photo", "3 photos"."""
    return f"{count} {noun}" if count == 1 else f"{count} {noun}s"
