//! import
pub mod checkpoint;
