//! What was photographed: readers that turn a folder into posed views and points.
