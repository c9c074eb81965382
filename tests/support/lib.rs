//! Support for the integration tests.

pub mod golden;
pub mod build;
