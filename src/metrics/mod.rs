//! Image metrics and reports.
