//! From the files of a step to the inputs of the network: the firmware's own sensors.

use super::log::LoggedFrame;
use firmware::drive::{Measurements, NetworkInputs, Reading, System};
use firmware::image::{Image, Port};
use firmware::sensors::camera::{Camera, CameraLayout, PixelFormat, Scale};
use firmware::sensors::correspondences::{Correspondences, Intrinsics};
use firmware::sensors::heatmap;
use firmware::sensors::lidar::{Histogram, Sweep};
use firmware::sensors::views::View;
use firmware::tensor::Shape;
use fixed::types::I16F16;
use model_compiler::error::{Error, ErrorCode, Result};
use model_compiler::frames::camera;
use std::path::{Path, PathBuf};

/// x, y, z, intensity as little-endian f32.
const POINT_BYTES: usize = 16;

/// The sensors that fill the inputs of one network.
#[derive(Debug)]
pub struct Rig<'a> {
    ports: Vec<(Port<'a>, Shape)>,
    histogram: Option<Histogram>,
}

impl<'a> Rig<'a> {
    /// The sensors for an image.
    ///
    /// # Errors
    /// A histogram of an impossible size, or views on which no goal is drawn.
    pub fn new(image: &Image<'a>, system: System) -> Result<Self> {
        let ports = (0..image.input_count()).filter_map(|index| image.input(index));
        let ports: Vec<_> = ports.filter_map(|port| Some((port, image.tensor(port.tensor)?.shape))).collect();
        let split = if system == System::TransFuser { I16F16::from_num(-2) } else { I16F16::from_num(2) };
        let bev = ports.iter().find(|(port, _)| port.name == "bev");
        let histogram = bev.map(|&(_, shape)| Histogram::new(shape, split)).transpose();
        let histogram = histogram.map_err(|e| Error::new(ErrorCode::Unsupported, "input `bev`", e.to_string()))?;
        let views = ports.iter().find(|(port, shape)| port.name == "views" && *shape != heatmap::MAP);
        if let Some((_, found)) = views {
            let [found, expected] = [*found, heatmap::MAP].map(|s| format!("{}×{}×{}", s.height, s.width, s.channels));
            let message = format!("it is {found}, the goal is drawn on {expected}");
            let error = Error::new(ErrorCode::Unsupported, "input `views`", message);
            return Err(error.with_help(format!("compile the network for {expected}; host-sim run takes any size")));
        }
        Ok(Self { ports, histogram })
    }

    /// The inputs, in the image's order.
    pub fn ports(&self) -> impl ExactSizeIterator<Item = &Port<'a>> {
        self.ports.iter().map(|(port, _)| port)
    }

    /// Shape of an input; `None` where the image has no such input.
    pub fn shape(&self, name: &str) -> Option<Shape> {
        self.ports.iter().find(|(port, _)| port.name == name).map(|&(_, shape)| shape)
    }

    /// Lets the sensors take the files of a step.
    ///
    /// # Errors
    /// A file of a sensor that is not missing is, or is damaged; or an input that no sensor of a log fills.
    pub fn sense(&self, frame: &LoggedFrame) -> Result<Sensed<'_, 'a>> {
        let mut measurements = frame.measurements;
        let Measurements { camera, lidar, .. } = frame.measurements;
        let reads_points = self.ports.iter().any(|(port, _)| matches!(port.name, "bev" | "bev_points" | "cam_points"));
        let points = (reads_points && is_there(lidar)).then(|| read_points(&frame.folder.join("lidar.bin")));
        let points = points.transpose()?.unwrap_or_default();
        let mut inputs = Vec::new();
        for (port, shape) in &self.ports {
            let mut codes = vec![0; shape.elements() as usize];
            match port.name {
                "rgb" if is_there(camera) => {
                    measurements.camera = capture(&frame.folder.join("rgb.png"), *shape, View::Front, &mut codes)?;
                }
                "views" if is_there(camera) => {
                    for (view, file) in View::LBC.into_iter().zip(["rgb.png", "rgb_left.png", "rgb_right.png"]) {
                        let reading = capture(&frame.folder.join(file), *shape, view, &mut codes)?;
                        if is_there(measurements.camera) {
                            measurements.camera = reading;
                        }
                    }
                }
                "bev" if is_there(lidar) => measurements.lidar = self.sweep(frame, &points, &mut codes)?,
                "bev_points" => [codes, _] = cells(*shape, frame, &points)?,
                "cam_points" => [_, codes] = cells(*shape, frame, &points)?,
                "rgb" | "views" | "bev" | "velocity" | "goal" | "command" => {}
                name => {
                    let message = "no sensor of a log gives this input";
                    return Err(Error::new(ErrorCode::Unsupported, format!("input `{name}`"), message));
                }
            }
            inputs.push(codes);
        }
        Ok(Sensed { rig: self, measurements, inputs })
    }

    fn sweep(&self, frame: &LoggedFrame, points: &[[u32; 3]], counts: &mut [i8]) -> Result<Reading<()>> {
        let Some(histogram) = self.histogram else { return Ok(Reading::Missing) };
        let refuse = |e| Error::new(ErrorCode::Unsupported, "input `bev`", format!("{e}"));
        let mut sweep = Sweep::new(histogram);
        sweep.start(counts).map_err(refuse)?;
        points.iter().for_each(|&point| sweep.push(frame.mounting.place(point), counts));
        Ok(sweep.finish().into())
    }
}

/// What the sensors gave in one step: to the driver, and to the network.
#[derive(Debug)]
pub struct Sensed<'r, 'a> {
    rig: &'r Rig<'a>,
    /// For the driver.
    pub measurements: Measurements,
    /// What camera and LiDAR wrote, per input; zeros where they wrote nothing.
    inputs: Vec<Vec<i8>>,
}

impl Sensed<'_, '_> {
    /// Bytes of all inputs of the network, with the small ones that the driver gives.
    ///
    /// # Errors
    /// The map of views has no channel for the goal.
    pub fn inputs(&self, small: &NetworkInputs) -> Result<Vec<Vec<u8>>> {
        let input = |(port, codes): (&Port<'_>, &Vec<i8>)| match port.name {
            "views" => {
                let mut codes = codes.clone();
                let drawn = heatmap::draw(small.goal.map(I16F16::to_bits), &mut codes);
                drawn.map_err(|e| Error::new(ErrorCode::Unsupported, "input `views`", e.to_string()))?;
                Ok(bytes(&codes))
            }
            "velocity" => Ok(small.velocity_bytes().to_vec()),
            "goal" => Ok(small.goal_bytes().to_vec()),
            "command" => Ok(small.command_bytes().to_vec()),
            _ => Ok(bytes(codes)),
        };
        self.rig.ports().zip(&self.inputs).map(input).collect()
    }
}

const fn is_there(reading: Reading<()>) -> bool {
    matches!(reading, Reading::Value { .. })
}

/// What a network sees of an image file: the centered crop, in the view's channels. No camera counts as frozen: a
/// recording of a standing vehicle may repeat its images.
fn capture(path: &Path, map: Shape, view: View, codes: &mut [i8]) -> Result<Reading<()>> {
    let image = camera::decode(path)?;
    let refuse = |message: String| Error::new(ErrorCode::Frames, path.display().to_string(), message);
    let size = [image.width(), image.height()].map(|side| u16::try_from(side).unwrap_or(u16::MAX));
    let layout = CameraLayout {
        width: size[0],
        height: size[1],
        format: PixelFormat::Rgb,
        scale: Scale::Full,
        map,
        first_channel: view.first_channel(),
        frozen_after: 0,
    };
    let mut memory = vec![0; layout.memory_words()];
    let mut camera = Camera::new(layout, &mut memory).map_err(|e| refuse(e.to_string()))?;
    let pushed = camera.push_image(image.as_raw(), image.width() * 3, codes);
    pushed.map_err(|e| refuse(e.to_string()))?;
    Ok(camera.finish().into())
}

/// Cells of Geometric Fusion: of the histogram, of the camera.
fn cells(shape: Shape, frame: &LoggedFrame, points: &[[u32; 3]]) -> Result<[Vec<i8>; 2]> {
    let [mut bev, mut camera] = [(); 2].map(|()| vec![0; shape.elements() as usize]);
    let mut lists = Correspondences::new(Intrinsics::PUBLISHED);
    let refuse = |e| Error::new(ErrorCode::Unsupported, "input `bev_points`", format!("{e}"));
    lists.start(&mut bev, &mut camera).map_err(refuse)?;
    points.iter().for_each(|&point| lists.push(frame.mounting.place(point), &mut bev, &mut camera));
    lists.finish();
    Ok([bev, camera])
}

fn read_points(path: &PathBuf) -> Result<Vec<[u32; 3]>> {
    let bytes = std::fs::read(path).map_err(|e| Error::io(path, &e))?;
    let (points, rest) = bytes.as_chunks::<POINT_BYTES>();
    if !rest.is_empty() {
        let message =
            format!("{} bytes, expected a multiple of {POINT_BYTES} (x, y, z, intensity as f32)", bytes.len());
        return Err(Error::new(ErrorCode::Frames, path.display().to_string(), message).with_help("is it truncated?"));
    }
    let word = |point: &[u8; POINT_BYTES], i: usize| u32::from_le_bytes([0, 1, 2, 3].map(|byte| point[4 * i + byte]));
    Ok(points.iter().map(|point| [0, 1, 2].map(|i| word(point, i))).collect())
}

fn bytes(codes: &[i8]) -> Vec<u8> {
    bytemuck::cast_slice(codes).to_vec()
}
