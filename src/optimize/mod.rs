//! From a capture to a scene.
