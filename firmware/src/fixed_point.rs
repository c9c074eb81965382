//! fixed_point
