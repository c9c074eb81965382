//! Support for the integration tests.

pub mod build;
pub mod every_step;
pub mod golden;
pub mod random;
pub mod torch_file;
