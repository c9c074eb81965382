//! Trained driving networks to int8 model images.
#![forbid(unsafe_code)]

pub mod artifact;
pub mod calibrate;
pub mod cli;
pub mod emit;
pub mod error;
pub mod flash;
pub mod frames;
pub mod image_diff;
pub mod import;
pub mod integer_reference;
pub mod ir;
pub mod known_answer;
pub mod memory_plan;
pub mod pack;
pub mod passes;
pub mod pipeline;
pub mod qmodel;
pub mod quantize;
pub mod record;
pub mod reference;
pub mod schedule;
pub mod target;
