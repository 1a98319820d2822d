//! Surfaces: ray queries, fusion of depth maps, simplification, unwrapping.
