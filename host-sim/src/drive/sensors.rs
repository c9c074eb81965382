//! From the files of a step to the inputs of the network: the firmware's own sensors.

use super::log::LoggedFrame;
use firmware::drive::{NetworkInputs, System};
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

    /// Bytes of all inputs in one step.
    ///
    /// # Errors
    /// A file of the step is missing or damaged.
    pub fn inputs(&self, frame: &LoggedFrame, small: &NetworkInputs) -> Result<Vec<Vec<u8>>> {
        let points = self.ports.iter().any(|(port, _)| matches!(port.name, "bev" | "bev_points" | "cam_points"));
        let points = points.then(|| read_points(&frame.folder.join("lidar.bin"))).transpose()?.unwrap_or_default();
        let input = |(port, shape): &(Port<'_>, Shape)| match port.name {
            "rgb" => {
                let mut codes = codes(*shape);
                capture(&frame.folder.join("rgb.png"), *shape, View::Front, &mut codes)?;
                Ok(bytes(&codes))
            }
            "views" => {
                let mut codes = codes(*shape);
                for (view, file) in View::LBC.into_iter().zip(["rgb.png", "rgb_left.png", "rgb_right.png"]) {
                    capture(&frame.folder.join(file), *shape, view, &mut codes)?;
                }
                let drawn = heatmap::draw(small.goal.map(I16F16::to_bits), &mut codes);
                drawn.map_err(|e| Error::new(ErrorCode::Unsupported, "input `views`", e.to_string()))?;
                Ok(bytes(&codes))
            }
            "bev" => Ok(bytes(&self.sweep(*shape, frame, &points)?)),
            "bev_points" => Ok(bytes(&cells(*shape, frame, &points)?[0])),
            "cam_points" => Ok(bytes(&cells(*shape, frame, &points)?[1])),
            "velocity" => Ok(small.velocity_bytes().to_vec()),
            "goal" => Ok(small.goal_bytes().to_vec()),
            "command" => Ok(small.command_bytes().to_vec()),
            name => Err(Error::new(
                ErrorCode::Unsupported,
                format!("input `{name}`"),
                "no sensor of a log gives this input",
            )),
        };
        self.ports.iter().map(input).collect()
    }

    fn sweep(&self, shape: Shape, frame: &LoggedFrame, points: &[[u32; 3]]) -> Result<Vec<i8>> {
        let mut counts = codes(shape);
        if let Some(histogram) = self.histogram {
            let refuse = |e| Error::new(ErrorCode::Unsupported, "input `bev`", format!("{e}"));
            let mut sweep = Sweep::new(histogram, &mut counts).map_err(refuse)?;
            points.iter().for_each(|&point| sweep.push(frame.mounting.place(point)));
            sweep.finish();
        }
        Ok(counts)
    }
}

/// What a network sees of an image file: the centered crop, in the view's channels.
fn capture(path: &Path, map: Shape, view: View, codes: &mut [i8]) -> Result<()> {
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
    camera.finish().map(|_| ()).map_err(|e| refuse(e.to_string()))
}

/// Cells of Geometric Fusion: of the histogram, of the camera.
fn cells(shape: Shape, frame: &LoggedFrame, points: &[[u32; 3]]) -> Result<[Vec<i8>; 2]> {
    let [mut bev, mut camera] = [codes(shape), codes(shape)];
    let lists = Correspondences::new(Intrinsics::PUBLISHED, &mut bev, &mut camera);
    let mut lists = lists.map_err(|e| Error::new(ErrorCode::Unsupported, "input `bev_points`", e.to_string()))?;
    points.iter().for_each(|&point| lists.push(frame.mounting.place(point)));
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

fn codes(shape: Shape) -> Vec<i8> {
    vec![0; shape.elements() as usize]
}

fn bytes(codes: &[i8]) -> Vec<u8> {
    bytemuck::cast_slice(codes).to_vec()
}
