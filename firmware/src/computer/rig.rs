//! The sensors of a network: pieces of a frame go into its inputs as they arrive.

use crate::drive::{NetworkInputs, Reading};
use crate::engine::Engine;
use crate::image::Image;
use crate::image::layout::MAX_PORTS;
use crate::kernels::Kernels;
use crate::link::{Configuration, Refusal};
use crate::sensors::camera::{Camera, CameraLayout};
use crate::sensors::correspondences::{Correspondences, ELEMENTS, Intrinsics};
use crate::sensors::heatmap;
use crate::sensors::lidar::{Histogram, Mounting, Sweep};
use crate::sensors::views::View;
use crate::tensor::{Shape, index};
use fixed::types::I16F16;
use heapless::Vec;

/// Most cameras of a network.
pub const MAX_CAMERAS: usize = View::LBC.len();
/// Words of memory per camera: enough for crops of up to 256 × 256 pixels, in halves, quarters and eighths too.
pub const CAMERA_WORDS: usize = 1024;

/// x, y, z as f32.
const POINT_BYTES: usize = 12;

/// Memory of the sensors.
#[derive(Clone, Debug)]
pub struct Memory {
    cameras: [[u16; CAMERA_WORDS]; MAX_CAMERAS],
    cells: Cells,
}

impl Memory {
    /// Memory before its first use.
    pub const fn new() -> Self {
        let cells = Cells { bev: [0; ELEMENTS], camera: [0; ELEMENTS] };
        Self { cameras: [[0; CAMERA_WORDS]; MAX_CAMERAS], cells }
    }
}

impl Default for Memory {
    fn default() -> Self {
        Self::new()
    }
}

/// The cells of Geometric Fusion; they grow side by side, and are copied to their inputs at the end of a frame.
#[derive(Clone, Debug)]
struct Cells {
    bev: [i8; ELEMENTS],
    camera: [i8; ELEMENTS],
}

/// How an input of the network is filled.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Source {
    Cameras,
    Sweep,
    BevCells,
    CameraCells,
    Velocity,
    Goal,
    Command,
    /// By [`crate::link::Request::Input`] alone.
    Pieces,
}

impl Source {
    fn of(name: &str) -> Self {
        match name {
            "rgb" | "views" => Self::Cameras,
            "bev" => Self::Sweep,
            "bev_points" => Self::BevCells,
            "cam_points" => Self::CameraCells,
            "velocity" => Self::Velocity,
            "goal" => Self::Goal,
            "command" => Self::Command,
            _ => Self::Pieces,
        }
    }
}

/// An input of the network.
#[derive(Clone, Copy, Debug)]
struct Input {
    source: Source,
    bytes: u32,
    /// Bytes that came as pieces in this frame.
    received: u32,
}

impl Input {
    const fn came_in_pieces(&self) -> bool {
        self.received == self.bytes
    }
}

/// What a frame brought.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Sensed {
    /// Of the cameras; `None` where nothing of theirs came.
    pub camera: Option<Reading<()>>,
    /// Of the LiDAR; `None` where nothing of its came.
    pub lidar: Option<Reading<()>>,
}

/// The sensors of a network, and how far the frame is.
#[derive(Debug)]
pub(super) struct Rig<'m> {
    inputs: Vec<Input, { MAX_PORTS as usize }>,
    cameras: Vec<Camera<'m>, MAX_CAMERAS>,
    /// Whether the goal belongs in the cameras' map.
    draws_goal: bool,
    mounting: Mounting,
    sweep: Option<Sweep>,
    cells: Option<(Correspondences, &'m mut Cells)>,
    has_rows: bool,
    has_points: bool,
    /// What the sensors said at the end of the frame.
    sensed: Sensed,
}

const NOTHING: Sensed = Sensed { camera: None, lidar: None };

impl<'m> Rig<'m> {
    /// The sensors that an image reads.
    ///
    /// # Errors
    /// No camera of this configuration fills the input, or no histogram has its size.
    pub fn new(image: &Image<'_>, configuration: &Configuration, memory: &'m mut Memory) -> Result<Self, Refusal> {
        let mut rig = Self::without_sensors(image)?;
        rig.mounting = Mounting::new(configuration.lidar_axes, configuration.lidar_height);
        let Memory { cameras, cells } = memory;
        let shape = |name: &str| {
            let mut ports = (0..image.input_count()).filter_map(|input| image.input(input));
            ports.find(|port| port.name == name).and_then(|port| image.tensor(port.tensor)).map(|record| record.shape)
        };
        let map = shape("views").or(shape("rgb"));
        rig.draws_goal = shape("views").is_some();
        let views = if shape("views").is_some() { &View::LBC[..] } else { &View::LBC[..1] };
        for (view, memory) in views.iter().zip(cameras).filter(|_| map.is_some()) {
            let layout = camera_layout(configuration, map.unwrap_or(Shape::map(0, 0, 0)), *view);
            let camera = Camera::new(layout, memory).map_err(|_| Refusal::Configuration)?;
            rig.cameras.push(camera).map_err(|_| Refusal::Configuration)?;
        }
        if let Some(shape) = shape("bev") {
            // Only TransFuser reads the speed beside the histogram, and only its channels part near the ground.
            let published = if rig.find(Source::Velocity).is_some() { -2 } else { 2 };
            let histogram =
                Histogram::new(shape, I16F16::const_from_int(published)).map_err(|_| Refusal::Configuration)?;
            rig.sweep = Some(Sweep::new(histogram));
        }
        if rig.find(Source::BevCells).is_some() {
            rig.cells = Some((Correspondences::new(Intrinsics::PUBLISHED), cells));
        }
        Ok(rig)
    }

    /// Inputs that come in pieces alone.
    ///
    /// # Errors
    /// The image's inputs cannot be told.
    pub fn without_sensors(image: &Image<'_>) -> Result<Self, Refusal> {
        let mut inputs = Vec::new();
        for input in 0..image.input_count() {
            let port = image.input(input).ok_or(Refusal::NoImage)?;
            let bytes = image.tensor(port.tensor).ok_or(Refusal::NoImage)?.bytes;
            let input = Input { source: Source::of(port.name), bytes, received: 0 };
            inputs.push(input).map_err(|_| Refusal::NoImage)?;
        }
        Ok(Self {
            inputs,
            cameras: Vec::new(),
            draws_goal: false,
            mounting: Mounting::TRAINED,
            sweep: None,
            cells: None,
            has_rows: false,
            has_points: false,
            sensed: NOTHING,
        })
    }

    /// Whether this configuration's cameras fill the image's input.
    pub fn check(image: &Image<'_>, configuration: &Configuration) -> Result<(), Refusal> {
        for input in (0..image.input_count()).filter_map(|input| image.input(input)) {
            if Source::of(input.name) == Source::Cameras {
                let map = image.tensor(input.tensor).ok_or(Refusal::NoImage)?.shape;
                let layout = camera_layout(configuration, map, View::Front);
                if layout.memory_words() > CAMERA_WORDS || layout.check().is_err() {
                    return Err(Refusal::Configuration);
                }
            }
        }
        Ok(())
    }

    fn find(&self, source: Source) -> Option<usize> {
        self.inputs.iter().position(|input| input.source == source)
    }

    /// Begins a frame.
    pub fn begin<K: Kernels>(&mut self, engine: &mut Engine<'_, K>) {
        self.inputs.iter_mut().for_each(|input| input.received = 0);
        self.cameras.iter_mut().for_each(Camera::clear);
        (self.has_rows, self.has_points, self.sensed) = (false, false, NOTHING);
        let bev = self.find(Source::Sweep);
        if let (Some(sweep), Some(counts)) = (&mut self.sweep, codes(engine, bev)) {
            // The input has the histogram's size: it was made for it.
            let _ = sweep.start(counts);
        }
        if let Some((lists, cells)) = &mut self.cells {
            let _ = lists.start(&mut cells.bev, &mut cells.camera);
        }
    }

    /// Part of a row of an image.
    ///
    /// # Errors
    /// The network reads no such camera, or the camera refuses the piece.
    pub fn row<K: Kernels>(
        &mut self,
        engine: &mut Engine<'_, K>,
        view: View,
        row: u16,
        offset: u32,
        bytes: &[u8],
    ) -> Result<(), Refusal> {
        let input = self.find(Source::Cameras);
        let camera = self.cameras.get_mut(view as usize).ok_or(Refusal::NoSuchSensor)?;
        let codes = codes(engine, input).ok_or(Refusal::NoSuchSensor)?;
        self.has_rows = true;
        camera.push(row.into(), offset, bytes, codes).map_err(|_| Refusal::Piece)
    }

    /// Points of the LiDAR.
    ///
    /// # Errors
    /// The network reads no LiDAR, or the last point is not whole.
    pub fn points<K: Kernels>(&mut self, engine: &mut Engine<'_, K>, bytes: &[u8]) -> Result<(), Refusal> {
        let (points, rest) = bytes.as_chunks::<POINT_BYTES>();
        if !rest.is_empty() {
            return Err(Refusal::Piece);
        }
        let bev = self.find(Source::Sweep);
        let mut counts = codes(engine, bev);
        if self.sweep.is_none() && self.cells.is_none() {
            return Err(Refusal::NoSuchSensor);
        }
        self.has_points = true;
        for [a, b, c, d, e, f, g, h, i, j, k, l] in points.iter().copied() {
            let bits = [[a, b, c, d], [e, f, g, h], [i, j, k, l]].map(u32::from_le_bytes);
            let point = self.mounting.place(bits);
            if let (Some(sweep), Some(counts)) = (&mut self.sweep, &mut counts) {
                sweep.push(point, counts);
            }
            if let Some((lists, cells)) = &mut self.cells {
                lists.push(point, &mut cells.bev, &mut cells.camera);
            }
        }
        Ok(())
    }

    /// Part of an input as the network reads it.
    ///
    /// # Errors
    /// There is no such input, or the piece does not follow the one before within the input.
    pub fn piece<K: Kernels>(
        &mut self,
        engine: &mut Engine<'_, K>,
        input: u8,
        offset: u32,
        bytes: &[u8],
    ) -> Result<(), Refusal> {
        let state = self.inputs.get_mut(usize::from(input)).ok_or(Refusal::NoSuchSensor)?;
        if offset != state.received {
            return Err(Refusal::Piece);
        }
        let slot = engine.input_mut(input.into()).map_err(|_| Refusal::NoSuchSensor)?;
        let target =
            slot.get_mut(index(offset)..).and_then(|rest| rest.get_mut(..bytes.len())).ok_or(Refusal::Piece)?;
        target.copy_from_slice(bytes);
        state.received = state.received.saturating_add(u32::try_from(bytes.len()).unwrap_or(u32::MAX));
        Ok(())
    }

    /// Ends the frame: what its sensors said.
    pub fn finish(&mut self) -> Sensed {
        let came = |source: Source, inputs: &[Input]| {
            inputs.iter().any(|input| input.source == source && input.came_in_pieces()).then(|| Reading::now(()))
        };
        let mut camera = came(Source::Cameras, &self.inputs);
        if self.has_rows {
            let readings = self.cameras.iter_mut().map(|camera| Reading::from(camera.finish()));
            camera = readings.fold(None, |first, reading| match first {
                Some(Reading::Value { .. }) | None => Some(reading),
                worse => worse,
            });
        }
        let mut lidar = came(Source::Sweep, &self.inputs);
        if self.has_points {
            lidar = self.sweep.as_mut().map(|sweep| sweep.finish().into());
        }
        self.sensed = Sensed { camera, lidar };
        self.sensed
    }

    /// Writes the small inputs and what belongs beside them. Whether the network has all that it reads.
    pub fn complete<K: Kernels>(&mut self, engine: &mut Engine<'_, K>, small: Option<&NetworkInputs>) -> bool {
        let is_there = |reading: Option<Reading<()>>| matches!(reading, Some(Reading::Value { .. }));
        let Sensed { camera, lidar } = self.sensed;
        let mut is_complete = true;
        for (number, input) in self.inputs.iter().enumerate() {
            if input.came_in_pieces() {
                continue;
            }
            let Ok(slot) = engine.input_mut(number) else { return false };
            is_complete &= match (input.source, small, &self.cells) {
                (Source::Cameras, Some(small), _) if self.draws_goal => {
                    let goal = small.goal.map(I16F16::to_bits);
                    let codes = bytemuck::try_cast_slice_mut::<u8, i8>(slot);
                    is_there(camera) && codes.is_ok_and(|codes| heatmap::draw(goal, codes).is_ok())
                }
                (Source::Cameras, ..) => is_there(camera) && !self.draws_goal,
                (Source::Sweep, ..) => is_there(lidar),
                (Source::BevCells, _, Some((_, cells))) => is_there(lidar) && copy(slot, &cells.bev),
                (Source::CameraCells, _, Some((_, cells))) => is_there(lidar) && copy(slot, &cells.camera),
                (Source::Velocity, Some(small), _) => put(slot, &small.velocity_bytes()),
                (Source::Goal, Some(small), _) => put(slot, &small.goal_bytes()),
                (Source::Command, Some(small), _) => put(slot, &small.command_bytes()),
                _ => false,
            };
        }
        is_complete
    }
}

fn camera_layout(configuration: &Configuration, map: Shape, view: View) -> CameraLayout {
    let setup = configuration.camera;
    CameraLayout {
        width: setup.width,
        height: setup.height,
        format: setup.format,
        scale: setup.scale,
        map,
        first_channel: view.first_channel(),
        frozen_after: setup.frozen_after,
    }
}

/// An input of codes.
fn codes<'e, K: Kernels>(engine: &'e mut Engine<'_, K>, input: Option<usize>) -> Option<&'e mut [i8]> {
    bytemuck::try_cast_slice_mut(engine.input_mut(input?).ok()?).ok()
}

fn copy(slot: &mut [u8], cells: &[i8; ELEMENTS]) -> bool {
    bytemuck::try_cast_slice::<i8, u8>(cells).is_ok_and(|bytes| put(slot, bytes))
}

fn put(slot: &mut [u8], bytes: &[u8]) -> bool {
    let fits = slot.len() == bytes.len();
    slot.iter_mut().zip(bytes).for_each(|(slot, byte)| *slot = *byte);
    fits
}
