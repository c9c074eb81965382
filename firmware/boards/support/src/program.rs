//! The programs that run on a board. Each answers the exit status: 0 right, 1 wrong.

pub mod check;
pub mod conformance;
pub mod drive;
pub mod measure;
pub mod self_test;
