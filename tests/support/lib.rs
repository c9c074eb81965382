//! Support for the integration tests.

pub mod build;
pub mod bundle;
pub mod golden;
pub mod torch_file;
