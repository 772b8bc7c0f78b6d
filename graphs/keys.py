"""GTSAM keys of the graph's variables, one function a kind."""

from __future__ import annotations

from gtsam.symbol_shorthand import B, K, L, S, T, X


def frame_key(frame: int) -> int:
    """rig_from_world of a frame (stored by GTSAM as the rig's pose in the world)."""
    return X(frame)


def rig_key(camera: int) -> int:
    """cam_from_rig of a camera (stored by GTSAM as the camera's pose in the rig)."""
    return T(camera)


def lens_key(camera: int) -> int:
    """The lens parameters of a camera."""
    return K(camera)


def point_key(point: int) -> int:
    """A scene point."""
    return L(point)


def board_key() -> int:
    """world_from_board of the board that stays put in a scan."""
    return B(0)


def shape_key() -> int:
    """The size and the bends of the board."""
    return S(0)
