//! The C interface of the runtime: a parsed model image, an engine in the caller's storage, inputs, steps, outputs.
//!
//! Nothing is allocated and nothing is global: an engine lives in a `fw_engine` that the caller provides, and works in
//! memory regions that the caller provides. Their sizes and alignments are what `fw_image_parse` tells of an image.
//!
//! Every call that can fail answers an `fw_status`; `FW_STATUS_OK` is 0. A call that fails has written nothing through
//! its result pointers. `fw_status_text` gives the words of a status, `fw_image_explain` and `fw_engine_explain` the
//! whole message: what is wrong, where, found, expected.
//!
//! Null pointers, misaligned pointers, lengths that cannot be, memory that overlaps, and an engine that was never set
//! up (its storage still being zero) are refused. What cannot be checked is the caller's part:
//!
//! - Pointers with a length point to that many bytes; result pointers to what they are declared as.
//! - The image does not change, and image, regions and engine stay where they are, as long as the engine is used.
//! - The regions are the engine's alone. Bytes of an input or output that a call gave out may be used until the next
//!   call with the same engine.
//! - An engine is used by one thread or interrupt at a time. Different engines are independent.
//!
//! A program in outline:
//!
//! ```c
//! static fw_engine engine;
//! static _Alignas(64) uint8_t arena[160 * 1024];
//!
//! fw_region region = { arena, sizeof arena };
//! fw_status status = fw_engine_init(&engine, image, image_bytes, &region, 1);
//! if (status == FW_STATUS_OK) status = fw_self_test(&engine);
//!
//! for each frame:
//!     fw_input(&engine, i, &bytes, &length), then fill bytes[0..length], for every input i
//!     fw_begin(&engine);
//!     do status = fw_step(&engine, &progress);   // between two steps: feed the watchdog, yield
//!     while (status == FW_STATUS_OK && progress.done < progress.steps);
//!     fw_waypoints(&engine, 0, waypoints, FW_MAX_WAYPOINTS, &count);
//! ```

#![allow(unsafe_code, reason = "C has only pointers; every block says why it is sound")]
#![allow(clippy::missing_safety_doc, reason = "the module page says what every caller owes")]
#![deny(
    clippy::indexing_slicing,
    clippy::arithmetic_side_effects,
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::panic
)]

use crate::arena::Regions;
use crate::engine::{Engine, EngineError, Progress};
use crate::image::layout::{self, MAX_PORTS};
use crate::image::{Image, Port};
use crate::kernels::Portable;
use core::ffi::{c_char, c_void};
use memory::{NOWHERE, Place, memory, memory_mut, overlap, place, result};

mod memory;
mod message;
mod status;
#[cfg(test)]
mod tests;
mod types;

pub use status::Status;
pub use types::{
    Bytes, ENGINE_WORDS, Element, EngineStorage, ImageInfo, MAX_REGIONS, MAX_WAYPOINTS, MODEL_NAME_BYTES,
    PORT_NAME_BYTES, PortInfo, ProgressInfo, Region, RegionNeed, WaypointQ16,
};

/// What an [`EngineStorage`] holds. `mark` comes first, so that it can be read before the rest is known to be there.
#[repr(C)]
struct State {
    mark: u64,
    /// Why the last call failed.
    error: Option<EngineError>,
    /// The regions, so that inputs can be told from them; as many as the image has.
    arena: [Place; MAX_REGIONS],
    engine: Engine<'static, Portable>,
}

/// Tells an engine that was set up from zeroed storage.
const MARK: u64 = u64::from_le_bytes(*b"fwengine");

/// Most inputs of a network.
const MAX_INPUTS: usize = MAX_PORTS as usize;

const _: () = assert!(size_of::<State>() <= size_of::<EngineStorage>());
const _: () = assert!(align_of::<State>() <= align_of::<EngineStorage>());

/// Version of the library, such as "0.1.0".
#[unsafe(no_mangle)]
pub extern "C" fn fw_version() -> *const c_char {
    concat!(env!("CARGO_PKG_VERSION"), "\0").as_ptr().cast()
}

/// What a status means, in a few words; of any other number: "unknown status".
#[unsafe(no_mangle)]
pub extern "C" fn fw_status_text(status: i32) -> *const c_char {
    let known = status::ALL.into_iter().find(|known| *known as i32 == status);
    known.map_or(c"unknown status", Status::words).as_ptr()
}

/// How long the image is that begins at `memory`, of which `capacity` bytes can be read: for an image in flash whose
/// length is known to its header alone.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn fw_image_length(memory: *const c_void, capacity: usize, bytes: *mut usize) -> Status {
    let measure = || {
        let (memory, bytes) = (place(memory, capacity)?, result(bytes)?);
        // SAFETY: the caller vouches for the bytes; they are not used after this call.
        let memory = unsafe { self::memory(memory) };
        let length = layout::stated_length(memory).filter(|length| *length <= capacity);
        let length = length.ok_or(Status::ImageMalformed)?;
        // SAFETY: `result` has checked what can be; the caller vouches for the rest.
        unsafe { bytes.write(length) };
        Ok(())
    };
    answer(measure())
}

/// Whether the bytes at `image` (aligned to 16) are a model image that this library can run, and what it asks for.
/// Reads header, tables and program, not the weights.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn fw_image_parse(image: *const c_void, bytes: usize, info: *mut ImageInfo) -> Status {
    let parse = || {
        let info = result(info)?;
        // SAFETY: the caller vouches for the bytes; they are not used after this call.
        let image = Image::parse(unsafe { memory(place(image, bytes)?) })?;
        // SAFETY: `result` has checked what can be; the caller vouches for the rest.
        unsafe { info.write(ImageInfo::from(&image)) };
        Ok(())
    };
    answer(parse())
}

/// `fw_image_parse`, then every byte of the image against its CRCs. Takes as long as the image is large.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn fw_image_check(image: *const c_void, bytes: usize) -> Status {
    let check = || {
        // SAFETY: the caller vouches for the bytes; they are not used after this call.
        Image::parse(unsafe { memory(place(image, bytes)?) })?.check()?;
        Ok(())
    };
    answer(check())
}

/// Why `fw_image_check` refuses an image: writes the message, ended by a zero and cut to `capacity` bytes, to `text`.
/// An accepted image gives an empty text. Answers what the writing gave, not what is wrong with the image.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn fw_image_explain(
    image: *const c_void,
    bytes: usize,
    text: *mut c_char,
    capacity: usize,
) -> Status {
    let explain = || {
        let (image, text) = (place(image, bytes)?, place(text.cast(), capacity)?);
        if overlap(image, text) {
            return Err(Status::Overlap);
        }
        // SAFETY: the caller vouches for image and text, which share no byte; they are not used after this call.
        let (image, text) = unsafe { (memory(image), memory_mut(text)) };
        match Image::parse(image) {
            Err(error) => message::write(text, error),
            Ok(image) => match image.check() {
                Err(error) => message::write(text, error),
                Ok(()) => message::write(text, ""),
            },
        }
        Ok(())
    };
    answer(explain())
}

/// Sets up an engine: parses the image and takes the regions, of which there must be as many as `fw_image_info` says,
/// each as large and as aligned. Whatever the regions hold is overwritten before it is read. An engine that is set up
/// may be set up anew.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn fw_engine_init(
    engine: *mut EngineStorage,
    image: *const c_void,
    image_bytes: usize,
    regions: *const Region,
    region_count: usize,
) -> Status {
    let initialize = || {
        let state = result(engine)?.cast::<State>();
        // SAFETY: the storage is aligned and large enough for a mark, and the caller's to give.
        unsafe { (&raw mut (*state).mark).write(0) };
        if regions.is_null() {
            return Err(Status::NullPointer);
        }
        if !regions.is_aligned() {
            return Err(Status::Misaligned);
        }
        let bytes = place(image, image_bytes)?;
        if overlap(bytes, storage(engine)) {
            return Err(Status::Overlap);
        }
        // SAFETY: the caller vouches for the bytes and keeps them unchanged as long as the engine is used.
        let image = Image::parse(unsafe { memory(bytes) })?;
        if region_count != usize::from(image.region_count()) {
            return Err(Status::RegionCount);
        }
        let mut arena = [NOWHERE; MAX_REGIONS];
        for index in 0..region_count {
            // SAFETY: not null, aligned, and the caller vouches for `region_count` of them.
            let region = unsafe { regions.wrapping_add(index).read() };
            let region = place(region.memory, region.bytes)?;
            if [bytes, storage(engine)].iter().chain(&arena).any(|other| overlap(region, *other)) {
                return Err(Status::Overlap);
            }
            if let Some(slot) = arena.get_mut(index) {
                *slot = region;
            }
        }
        let lend = |region: &Place| -> &'static mut [u8] {
            // SAFETY: the caller gives the regions to this engine alone; they share no byte with each other, the engine
            // or the image.
            unsafe { memory_mut(*region) }
        };
        let regions: Regions<'static> = arena.iter().take(region_count).map(lend).collect();
        let engine = Engine::new(image, Portable, regions)?;
        // SAFETY: the storage is aligned and large enough for the state (asserted above), and the caller's to give.
        unsafe { state.write(State { mark: MARK, error: None, arena, engine }) };
        Ok(())
    };
    answer(initialize())
}

/// Why the last call with this engine failed: writes the message, ended by a zero and cut to `capacity` bytes, to
/// `text`; empty where it did not fail or its pointers were refused.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn fw_engine_explain(engine: *mut EngineStorage, text: *mut c_char, capacity: usize) -> Status {
    let explain = || {
        // SAFETY: the caller vouches for the engine.
        let state = unsafe { state(engine)? };
        let text = place(text.cast(), capacity)?;
        if overlap(text, storage(engine)) || state.owns(text) {
            return Err(Status::Overlap);
        }
        // SAFETY: the caller vouches for the text, which is no part of engine or arena.
        let text = unsafe { memory_mut(text) };
        match state.error {
            Some(error) => message::write(text, error),
            None => message::write(text, ""),
        }
        Ok(())
    };
    answer(explain())
}

/// What the input of an index is.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn fw_input_port(engine: *mut EngineStorage, input: usize, port: *mut PortInfo) -> Status {
    // SAFETY: the caller vouches for the engine and for where the port goes.
    unsafe { describe(engine, port, |image| image.input(u8::try_from(input).ok()?)) }
}

/// What the output of an index is.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn fw_output_port(engine: *mut EngineStorage, output: usize, port: *mut PortInfo) -> Status {
    // SAFETY: the caller vouches for the engine and for where the port goes.
    unsafe { describe(engine, port, |image| image.output(u8::try_from(output).ok()?)) }
}

/// The bytes of an input, to be filled in place before `fw_begin`. Abandons an inference that is under way. An
/// inference overwrites its inputs: each must be filled anew for every one.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn fw_input(
    engine: *mut EngineStorage,
    input: usize,
    bytes: *mut *mut u8,
    length: *mut usize,
) -> Status {
    let give = || {
        let (bytes, length) = (result(bytes)?, result(length)?);
        // SAFETY: the caller vouches for the engine.
        let state = unsafe { state(engine)? };
        let (start, count) = state.call(|engine| {
            let slot = engine.input_mut(input)?;
            Ok((slot.as_mut_ptr(), slot.len()))
        })?;
        // SAFETY: `result` has checked what can be; the caller vouches for the rest.
        unsafe {
            bytes.write(start);
            length.write(count);
        }
        Ok(())
    };
    answer(give())
}

/// Begins an inference over what was written to the inputs (`fw_input`).
#[unsafe(no_mangle)]
pub unsafe extern "C" fn fw_begin(engine: *mut EngineStorage) -> Status {
    // SAFETY: the caller vouches for the engine.
    let state = unsafe { state(engine) };
    answer(state.and_then(|state| {
        state.call(|engine| {
            engine.begin();
            Ok(())
        })
    }))
}

/// Begins an inference: copies `count` inputs, in the order of their indices. Abandons one that is under way.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn fw_start(engine: *mut EngineStorage, inputs: *const Bytes, count: usize) -> Status {
    let start = || {
        if inputs.is_null() {
            return Err(Status::NullPointer);
        }
        if !inputs.is_aligned() {
            return Err(Status::Misaligned);
        }
        // SAFETY: the caller vouches for the engine.
        let state = unsafe { state(engine)? };
        let mut slices = heapless::Vec::<&[u8], MAX_INPUTS>::new();
        for index in 0..count {
            // SAFETY: not null, aligned, and the caller vouches for `count` of them.
            let Bytes { data, bytes } = unsafe { inputs.wrapping_add(index).read() };
            let input = place(data, bytes)?;
            if overlap(input, storage(engine)) || state.owns(input) {
                return Err(Status::Overlap);
            }
            // SAFETY: the caller vouches for the bytes, which are no part of engine or arena.
            let slice = unsafe { memory(input) };
            slices.push(slice).map_err(|_| Status::InputCount)?;
        }
        state.call(|engine| engine.start(&slices))
    };
    answer(start())
}

/// Runs the next step of the inference to its end. When `progress->done == progress->steps` the outputs can be read;
/// another call does nothing then.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn fw_step(engine: *mut EngineStorage, progress: *mut ProgressInfo) -> Status {
    // SAFETY: the caller vouches for the engine and for where the progress goes.
    answer(unsafe { advance(engine, progress, Engine::step) })
}

/// Runs all steps that remain.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn fw_run(engine: *mut EngineStorage) -> Status {
    let run = |engine: &mut Engine<'_, Portable>| {
        while engine.step()? != Progress::Done {}
        Ok(())
    };
    // SAFETY: the caller vouches for the engine.
    answer(unsafe { state(engine) }.and_then(|state| state.call(run)))
}

/// The bytes of an output, after the last step.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn fw_output(
    engine: *mut EngineStorage,
    output: usize,
    bytes: *mut *const u8,
    length: *mut usize,
) -> Status {
    let give = || {
        let (bytes, length) = (result(bytes)?, result(length)?);
        // SAFETY: the caller vouches for the engine.
        let state = unsafe { state(engine)? };
        let (start, count) = state.call(|engine| engine.output(output).map(|slot| (slot.as_ptr(), slot.len())))?;
        // SAFETY: `result` has checked what can be; the caller vouches for the rest.
        unsafe {
            bytes.write(start);
            length.write(count);
        }
        Ok(())
    };
    answer(give())
}

/// The waypoints of an output, after the last step: at most `capacity`, their number goes to `count`. An array of
/// `FW_MAX_WAYPOINTS` is always long enough.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn fw_waypoints(
    engine: *mut EngineStorage,
    output: usize,
    waypoints: *mut WaypointQ16,
    capacity: usize,
    count: *mut usize,
) -> Status {
    let give = || {
        let (waypoints, count) = (result(waypoints)?, result(count)?);
        // SAFETY: the caller vouches for the engine.
        let found = unsafe { state(engine)? }.call(|engine| engine.waypoints(output))?;
        if found.len() > capacity {
            return Err(Status::TooShort);
        }
        for (index, waypoint) in found.iter().enumerate() {
            // SAFETY: `index` is below `capacity`, for which the caller vouches.
            unsafe { waypoints.wrapping_add(index).write(WaypointQ16::from(waypoint)) };
        }
        // SAFETY: `result` has checked what can be; the caller vouches for the rest.
        unsafe { count.write(found.len()) };
        Ok(())
    };
    answer(give())
}

/// The whole self-test: an inference over seeded inputs, every step's bytes compared with the image's known answer.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn fw_self_test(engine: *mut EngineStorage) -> Status {
    // SAFETY: the caller vouches for the engine.
    answer(unsafe { state(engine) }.and_then(|state| state.call(Engine::self_test)))
}

/// Begins the self-test, for a program that goes on with `fw_self_test_step`.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn fw_self_test_start(engine: *mut EngineStorage) -> Status {
    // SAFETY: the caller vouches for the engine.
    answer(unsafe { state(engine) }.and_then(|state| state.call(Engine::start_self_test)))
}

/// Runs the next step of the self-test; it has passed when `progress->done == progress->steps`.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn fw_self_test_step(engine: *mut EngineStorage, progress: *mut ProgressInfo) -> Status {
    // SAFETY: the caller vouches for the engine and for where the progress goes.
    answer(unsafe { advance(engine, progress, Engine::self_test_step) })
}

impl State {
    /// Whether a byte of this place lies in a region.
    fn owns(&self, place: Place) -> bool {
        self.arena.iter().any(|region| overlap(place, *region))
    }

    /// A call of the engine; why it failed is remembered.
    fn call<T>(
        &mut self,
        call: impl FnOnce(&mut Engine<'static, Portable>) -> Result<T, EngineError>,
    ) -> Result<T, Status> {
        let result = call(&mut self.engine);
        self.error = result.as_ref().err().copied();
        result.map_err(Status::from)
    }
}

fn answer(result: Result<(), Status>) -> Status {
    result.err().unwrap_or(Status::Ok)
}

fn storage(engine: *const EngineStorage) -> Place {
    (engine.cast(), size_of::<EngineStorage>())
}

/// The state of an engine that `fw_engine_init` has set up.
///
/// # Safety
/// An engine's storage lies there, set up or zero, and nothing else uses it during `'a`.
unsafe fn state<'a>(engine: *mut EngineStorage) -> Result<&'a mut State, Status> {
    let state = result(engine)?.cast::<State>();
    // SAFETY: not null and aligned, and the caller vouches for the storage; any bytes are a mark.
    if unsafe { (&raw const (*state).mark).read() } != MARK {
        return Err(Status::NotInitialized);
    }
    // SAFETY: as above; the mark tells that `fw_engine_init` has written the state.
    Ok(unsafe { &mut *state })
}

/// # Safety
/// As [`state`]; a port may be written to `to`.
unsafe fn describe(
    engine: *mut EngineStorage,
    to: *mut PortInfo,
    port: impl FnOnce(&Image<'static>) -> Option<Port<'static>>,
) -> Status {
    let describe = || {
        let to = result(to)?;
        // SAFETY: the caller vouches for the engine.
        let image = unsafe { state(engine)? }.engine.image();
        let port = port(image).ok_or(Status::NoSuchPort)?;
        let record = image.tensor(port.tensor).ok_or(Status::ImageChanged)?;
        let info = PortInfo::new(&port, &record).ok_or(Status::ImageChanged)?;
        // SAFETY: `result` has checked what can be; the caller vouches for the rest.
        unsafe { to.write(info) };
        Ok(())
    };
    answer(describe())
}

/// Does a step and says how far the inference is.
///
/// # Safety
/// As [`state`]; the progress may be written to `to`.
unsafe fn advance(
    engine: *mut EngineStorage,
    to: *mut ProgressInfo,
    step: impl FnOnce(&mut Engine<'static, Portable>) -> Result<Progress, EngineError>,
) -> Result<(), Status> {
    let to = result(to)?;
    // SAFETY: the caller vouches for the engine.
    let state = unsafe { state(engine)? };
    let progress = state.call(step)?;
    let steps = state.engine.image().step_count().into();
    let done = match progress {
        Progress::Running { next } => next.into(),
        Progress::Done => steps,
    };
    // SAFETY: `result` has checked what can be; the caller vouches for the rest.
    unsafe { to.write(ProgressInfo { done, steps }) };
    Ok(())
}

/// The library alone has nobody else who would say what a panic does. Nothing here panics.
#[cfg(target_os = "none")]
#[panic_handler]
fn panic(_: &core::panic::PanicInfo<'_>) -> ! {
    loop {
        core::hint::spin_loop();
    }
}
