//! Support for the integration tests.

pub mod golden;
pub mod build;
pub mod torch_file;
