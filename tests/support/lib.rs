//! Support for the integration tests.

pub mod build;
pub mod bundle;
pub mod commands;
pub mod golden;
pub mod project;
pub mod torch_file;
