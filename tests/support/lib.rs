//! Support for the integration tests.

pub mod build;
pub mod commands;
pub mod golden;
pub mod torch_file;
