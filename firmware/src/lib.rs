//! Runtime for quantized driving networks: `no_std`, no heap, no float in inference, no panic after validation.
//!
//! A network arrives as a *model image*, written by the compiler and executed in place. The runtime proves once that
//! the image cannot lead it astray, and then runs it step by step in memory that the caller owns:
//!
//! ```
//! use firmware::engine::{Engine, EngineError, Progress};
//! use firmware::image::Image;
//! use firmware::kernels::Portable;
//! use firmware::waypoint::Waypoint;
//!
//! /// The first waypoint of one frame.
//! fn drive(image: Image, arena: &mut [u8], frame: &[&[u8]]) -> Result<Option<Waypoint>, EngineError> {
//!     let mut engine = Engine::new(image, Portable, arena)?;
//!     engine.start(frame)?;
//!     while engine.step()? != Progress::Done {
//!         // feed the watchdog, yield, or abandon the frame
//!     }
//!     Ok(engine.waypoints(0)?.first().copied())
//! }
//!
//! let refused = Image::parse(&[0; 100]).unwrap_err();
//! println!("{refused}"); // what is wrong, where, found, expected
//! ```
//!
//! # Layers, top first
//!
//! * [`computer`]: the whole driving computer behind a serial [`link`]: frames in, [`actuators`] set, telemetry out.
//! * [`drive`]: around the network: route, goal, waypoints to steer, throttle and brake, supervision. Fixed point.
//! * [`engine`]: `start`, `step`, `infer`, self-test. Owns nothing but a position.
//! * [`ops`]: one operator per file: what its step must satisfy, and how it becomes a call of a kernel.
//! * [`arena`]: the operands of a step as disjoint slices of the memory regions, by checked means only.
//! * [`kernels`]: one method per operator; [`kernels::portable`] is the norm, other backends equal it byte for byte.
//!   [`kernels::plan`] tells compiler and runtime what a kernel needs. Under the feature `conformance` a sweep proves it.
//! * [`image`] and [`program`]: the file format, its checks, and the steps. The compiler writes what these define.
//! * [`update`]: a new image in the field: two slots of a flash, and the start that chooses between them.
//! * [`sensors`]: camera rows, LiDAR points, speed and goal as the network reads them.
//! * `ffi`, under the feature of this name: the same for programs in C; the header is `include/firmware.h`.
//! * [`waypoint`]: the network's result as a controller reads it.
//! * [`tensor`] and [`fixed_point`]: shapes, types and the one arithmetic.
//!
//! # Promises
//!
//! 1. After [`image::Image::parse`] accepted an image, nothing here panics, allocates, loops without bound or touches
//!    memory outside the arena, whatever the constants hold. The work of one inference is known
//!    ([`image::Image::work`]).
//! 2. An operator never sees overlapping operands: slices are cut at run time by `get_disjoint_mut`, independently of
//!    what `parse` proved. There is no `unsafe` outside kernel backends and the C interface, and none relies on
//!    `parse`.
//! 3. If the image's memory changes after `parse`, `step` answers [`engine::EngineError::ImageChanged`] or computes
//!    wrong numbers. [`image::Checker`] finds such a change, a slice of bytes at a time.
//! 4. Equal image and inputs give equal bytes on every backend and machine: the arithmetic is integers with one
//!    rounding rule.
//!
//! What is *not* promised: that the numbers are good (the host compares them with the float model), that an image is
//! authentic (a CRC is not a signature), and any bound on time other than the number of operations.
#![no_std]
#![deny(unsafe_code)]

#[cfg(not(target_endian = "little"))]
compile_error!("model images are little-endian and executed in place");

pub mod actuators;
pub mod arena;
pub mod computer;
#[cfg(any(test, feature = "conformance"))]
pub mod conformance;
pub mod drive;
pub mod engine;
pub mod fault;
#[cfg(feature = "ffi")]
pub mod ffi;
pub mod fixed_point;
pub mod image;
pub mod kernels;
pub mod link;
pub mod ops;
pub mod program;
pub mod sensors;
pub mod tensor;
pub mod update;
pub mod waypoint;
