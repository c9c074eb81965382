//! Memory for an engine.

/// Memory aligned as an engine's arena needs it.
#[derive(Debug)]
#[repr(align(64))]
pub struct Arena<const BYTES: usize>(pub [u8; BYTES]);
