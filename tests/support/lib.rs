//! Support for the integration tests.

pub mod torch_file;
