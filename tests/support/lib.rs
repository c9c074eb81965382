//! Support for the integration tests.

pub mod agent;
pub mod boards;
pub mod build;
pub mod bundle;
pub mod c_header;
pub mod commands;
pub mod device;
pub mod drive_log;
pub mod every_step;
pub mod golden;
pub mod mutation;
pub mod nor_flash;
pub mod onnx_file;
pub mod onnxruntime;
pub mod project;
pub mod random;
pub mod random_graph;
pub mod serial_board;
pub mod sketch;
pub mod torch_file;
pub mod trial;
