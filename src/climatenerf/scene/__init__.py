from climatenerf.core.cameras import Camera
from climatenerf.scene.images import load_image
from climatenerf.scene.read import read_scene
from climatenerf.scene.scene import Scene, View, load_scene, save_scene

__all__ = ["Camera", "Scene", "View", "load_image", "load_scene", "read_scene", "save_scene"]
