//! Camera, LiDAR, speed and goal of one moment, as a network reads them: for calibration and for evaluation.
//!
//! Three sources give the same [`Frame`]:
//! * a **frame directory** `FRAMES/<name>/{rgb.png, lidar.bin, frame.json}`: sensor data, prepared here ([`camera`],
//!   [`bev`], [`correspondence`], [`views`]) by the rules that the networks were trained with
//! * an **image directory**, for classifiers: PNG or JPEG files and, optionally, their labels ([`images`])
//! * a **tensor file** (`.safetensors`) of ready network inputs, first dimension = frames
//!
//! What has to be present follows from the network ([`FrameFormat`]); the rest may be missing.

use crate::error::{Error, ErrorCode, Result};
use crate::ir::{Graph, InputKind};
use crate::qmodel::QModel;
use firmware::tensor::Shape;
use sha2::{Digest, Sha256};
use std::path::Path;

pub mod bev;
pub mod camera;
pub mod correspondence;
mod directory;
pub mod images;
pub mod labels;
mod tensors;
pub mod views;

pub use labels::Label;

/// Which inputs a network reads, and how its LiDAR histogram is cut.
#[derive(Clone, Debug, PartialEq)]
pub struct FrameFormat {
    /// Image `H×W×3`, or `H×W×1` where a classifier reads grey levels.
    pub image: Option<Shape>,
    /// What a classifier calls its image input; driving systems call it `rgb`.
    pub image_name: String,
    /// Number of classes, if the network is a classifier: it reads one image and gives a vector.
    pub classes: Option<u16>,
    /// A classifier's images are scaled to this shorter side and cropped; without it they have the network's size.
    pub resize: Option<u16>,
    /// LiDAR histogram `lateral×longitudinal×2`.
    pub bev: Option<Shape>,
    /// Forward speed.
    pub velocity: bool,
    /// Goal point.
    pub goal: bool,
    /// Cells that see the same points, of the LiDAR map and of the image map: `H×W×2K`.
    pub points: Option<Shape>,
    /// Navigation command.
    pub command: bool,
    /// Three camera views and the heatmap of the target, `H×W×10`.
    pub views: Option<Shape>,
    /// Height that separates the two histogram channels: meters, relative to a sensor 2.5 m above ground.
    pub split_height_m: f64,
}

impl FrameFormat {
    /// The format of a network of this system with these inputs.
    pub fn new(system: &str, inputs: impl IntoIterator<Item = (InputKind, Shape)>) -> Self {
        let mut format = Self {
            image: None,
            image_name: InputKind::Image.name().into(),
            classes: None,
            resize: None,
            bev: None,
            velocity: false,
            goal: false,
            points: None,
            command: false,
            views: None,
            split_height_m: split_height_m(system),
        };
        for (kind, shape) in inputs {
            match kind {
                InputKind::Image => format.image = Some(shape),
                InputKind::Bev => format.bev = Some(shape),
                InputKind::Velocity => format.velocity = true,
                InputKind::Goal => format.goal = true,
                InputKind::BevPoints | InputKind::CameraPoints => format.points = Some(shape),
                InputKind::Command => format.command = true,
                InputKind::Views => format.views = Some(shape),
            }
        }
        format
    }

    /// The same, of a classifier if there is nothing but one image to read and the first output is a vector.
    #[must_use]
    pub fn with_output(mut self, image_name: &str, output: Option<Shape>) -> Self {
        let maps = self.bev.is_some() || self.points.is_some() || self.views.is_some();
        let is_only_input = self.image.is_some() && !(maps || self.velocity || self.goal || self.command);
        self.classes = output.filter(|s| is_only_input && (s.height, s.width) == (1, 1)).map(|s| s.channels);
        if self.classes.is_some() {
            self.image_name = image_name.into();
        }
        self
    }

    /// The format that a float graph reads.
    pub fn of_graph(graph: &Graph) -> Self {
        let format = Self::new(&graph.system, graph.inputs().map(|(id, kind)| (kind, graph.value(id).shape)));
        let name = graph.inputs().next().map_or("", |(id, _)| &graph.value(id).name);
        format.with_output(name, graph.outputs.first().map(|&id| graph.value(id).shape))
    }

    /// The format that a quantized model reads.
    pub fn of_model(model: &QModel) -> Self {
        let inputs = model.inputs.iter().filter_map(|port| Some((port.kind?, model.tensor(port.tensor).shape)));
        let name = model.inputs.first().map_or("", |port| &port.name);
        Self::new(&model.system, inputs)
            .with_output(name, model.outputs.first().map(|port| model.tensor(port.tensor).shape))
    }
}

/// TransFuser cuts half a meter above ground; the baselines were trained with the cut far above everything.
fn split_height_m(system: &str) -> f64 {
    match system {
        "late_fusion" | "geometric_fusion" => 2.0,
        _ => -2.0,
    }
}

/// A byte map, channel fastest.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ByteMap {
    /// Height, width, channels.
    pub shape: Shape,
    /// `height·width·channels` values.
    pub data: Vec<u8>,
}

/// A map of real values, channel fastest.
#[derive(Clone, Debug, PartialEq)]
pub struct RealMap {
    /// Height, width, channels.
    pub shape: Shape,
    /// `height·width·channels` values.
    pub data: Vec<f32>,
}

/// One moment of driving, or one image to classify.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Frame {
    /// Folder or file name, or `FILE#INDEX`.
    pub name: String,
    /// Image `H×W×3` (or `H×W×1`), 0..=255, of the network's size.
    pub rgb: Option<ByteMap>,
    /// LiDAR counts 0..=5, `lateral×longitudinal×2`; rows from right to left, columns from far to near.
    pub bev: Option<ByteMap>,
    /// Forward speed, m/s.
    pub velocity: Option<f64>,
    /// Goal `[right, forward-negative]`, m.
    pub goal: Option<[f64; 2]>,
    /// Views front, left, right (three channels each) and the heatmap of the target, `H×W×10` in grey levels 0..=255.
    pub views: Option<RealMap>,
    /// Navigation command 1..=6: left, right, straight, lane follow, change left, change right.
    pub command: Option<u8>,
    /// Cells of the camera image for each cell of the LiDAR map ([`correspondence`]).
    pub bev_points: Option<ByteMap>,
    /// Cells of the LiDAR map for each cell of the camera image.
    pub camera_points: Option<ByteMap>,
    /// LiDAR points with a coordinate that is not finite; they are left out.
    pub dropped_points: usize,
    /// What is to be seen, where somebody said so.
    pub label: Option<Label>,
    /// Forward speed, m/s, where the source tells it: for the controller behind a network, whether or not the network
    /// reads it as [`Self::velocity`].
    pub speed: Option<f64>,
}

impl Frame {
    /// The values of one network input in raw units: grey levels (of views not always whole ones), counts, m/s, m, a
    /// command's number, numbers of cells.
    ///
    /// # Errors
    /// The frame does not hold this input.
    pub fn raw(&self, kind: InputKind) -> Result<Vec<f32>> {
        let bytes = |map: &ByteMap| map.data.iter().map(|&v| f32::from(v)).collect();
        let values = match kind {
            InputKind::Image => self.rgb.as_ref().map(bytes),
            InputKind::Bev => self.bev.as_ref().map(bytes),
            InputKind::Velocity => self.velocity.map(|v| vec![v as f32]),
            InputKind::Goal => self.goal.map(|g| g.map(|v| v as f32).to_vec()),
            InputKind::BevPoints => self.bev_points.as_ref().map(bytes),
            InputKind::CameraPoints => self.camera_points.as_ref().map(bytes),
            InputKind::Command => self.command.map(|c| vec![f32::from(c)]),
            InputKind::Views => self.views.as_ref().map(|views| views.data.clone()),
        };
        values.ok_or_else(|| {
            Error::new(ErrorCode::Frames, format!("frame {}", self.name), format!("holds no {} input", kind.name()))
        })
    }

    /// The same moment seen in a mirror: left and right change places. A second, independent sample for evaluation.
    #[must_use]
    pub fn mirrored(&self) -> Self {
        Self {
            name: format!("{} (mirrored)", self.name),
            rgb: self.rgb.as_ref().map(flip_columns),
            bev: self.bev.as_ref().map(flip_rows),
            goal: self.goal.map(|[right, y]| [0.0 - right, y]),
            views: self.views.as_ref().map(views::mirrored),
            command: self.command.map(mirrored_command),
            bev_points: self.bev_points.as_ref().map(correspondence::mirrored),
            camera_points: self.camera_points.as_ref().map(correspondence::mirrored),
            ..self.clone()
        }
    }

    /// SHA-256 over everything that a network reads of this frame. The name does not count, nor the speed beside the
    /// network, nor the command: the calibration runs a frame under every command.
    pub fn digest(&self) -> [u8; 32] {
        let mut hash = Sha256::new();
        for kind in InputKind::ALL.into_iter().filter(|&kind| kind != InputKind::Command) {
            if let Ok(values) = self.raw(kind) {
                hash.update(kind.name());
                values.iter().for_each(|v| hash.update(v.to_le_bytes()));
            }
        }
        hash.finalize().into()
    }

    /// The first 16 hexadecimal digits of [`Self::digest`]: how provenance names a frame.
    pub fn short_digest(&self) -> String {
        self.digest()[..8].iter().map(|byte| format!("{byte:02x}")).collect()
    }
}

/// Loads frames: a directory is a frame directory (of a classifier: of images), a file is a tensor file.
///
/// # Errors
/// Anything missing, damaged or misshapen, with its file and field; no frame at all.
pub fn load(path: &Path, format: &FrameFormat) -> Result<Vec<Frame>> {
    let help = match format.classes {
        None => "frames are a directory FRAMES/<name>/{rgb.png, lidar.bin, frame.json} or a .safetensors file",
        Some(_) => "frames are a directory of images, optionally with labels.csv, or a .safetensors file",
    };
    let metadata = std::fs::metadata(path).map_err(|e| Error::io(path, &e).with_help(help))?;
    match (metadata.is_dir(), format.classes) {
        (true, Some(classes)) => images::load(path, format, classes),
        _ if format.resize.is_some() => {
            let error = Error::new(ErrorCode::Usage, path.display().to_string(), "nothing here can be scaled");
            Err(error.with_help("leave --resize out: it is for directories of images to classify"))
        }
        (true, None) => directory::load(path, format),
        (false, _) => tensors::load(path, format),
    }
}

/// Names of the evaluation frames that are also among the calibration frames, given by their short digests.
pub fn overlap<'a>(calibration_digests: &[&str], evaluation: &'a [Frame]) -> Vec<&'a str> {
    let is_known = |frame: &&Frame| calibration_digests.contains(&frame.short_digest().as_str());
    evaluation.iter().filter(is_known).map(|frame| frame.name.as_str()).collect()
}

fn flip_columns(map: &ByteMap) -> ByteMap {
    let (row, pixel) =
        (usize::from(map.shape.width) * usize::from(map.shape.channels), usize::from(map.shape.channels));
    let data = map.data.chunks(row).flat_map(|r| r.chunks(pixel).rev().flatten().copied()).collect();
    ByteMap { shape: map.shape, data }
}

fn flip_rows(map: &ByteMap) -> ByteMap {
    let row = usize::from(map.shape.width) * usize::from(map.shape.channels);
    ByteMap { shape: map.shape, data: map.data.chunks(row).rev().flatten().copied().collect() }
}

/// 1 left, 2 right, 5 change left, 6 change right; 3 straight and 4 follow stay.
fn mirrored_command(command: u8) -> u8 {
    match command {
        1 => 2,
        2 => 1,
        5 => 6,
        6 => 5,
        other => other,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn frame() -> Frame {
        Frame {
            name: "a".into(),
            rgb: Some(ByteMap { shape: Shape::map(1, 2, 3), data: vec![1, 2, 3, 4, 5, 6] }),
            bev: Some(ByteMap { shape: Shape::map(2, 2, 1), data: vec![0, 1, 2, 3] }),
            velocity: Some(3.5),
            goal: Some([1.0, -20.0]),
            command: Some(1),
            ..Frame::default()
        }
    }

    #[test]
    fn mirroring_swaps_left_and_right_and_twice_is_identity() {
        let mirrored = frame().mirrored();
        assert_eq!(mirrored.rgb.as_ref().unwrap().data, [4, 5, 6, 1, 2, 3]);
        assert_eq!(mirrored.bev.as_ref().unwrap().data, [2, 3, 0, 1]);
        assert_eq!(mirrored.goal, Some([-1.0, -20.0]));
        assert_eq!(mirrored.velocity, Some(3.5));
        assert_eq!(mirrored.command, Some(2));
        let twice = Frame { name: "a".into(), ..mirrored.mirrored() };
        assert_eq!(twice, frame());
    }

    #[test]
    fn overlap_finds_equal_content_under_another_name() {
        let renamed = Frame { name: "b".into(), ..frame() };
        let faster = Frame { name: "c".into(), velocity: Some(4.0), ..frame() };
        let digest = frame().short_digest();
        assert_eq!(digest.len(), 16);
        let told = Frame { name: "d".into(), speed: Some(3.5), ..frame() };
        let evaluation = [renamed, faster, frame().mirrored(), told];
        assert_eq!(overlap(&["0123456789abcdef", &digest], &evaluation), ["b", "d"]);
        assert!(overlap(&[], &evaluation).is_empty());
    }

    #[test]
    fn a_missing_input_is_named() {
        let error = Frame { bev: None, ..frame() }.raw(InputKind::Bev).unwrap_err();
        assert_eq!(error.to_string(), "frame a: holds no bev input");
    }

    #[test]
    fn the_format_follows_from_the_system_and_its_inputs() {
        let bev = Shape::map(256, 256, 2);
        let late = FrameFormat::new("late_fusion", [(InputKind::Bev, bev), (InputKind::Goal, Shape::vector(2))]);
        assert_eq!(late.bev, Some(bev));
        assert!(late.goal && !late.velocity && !late.command && late.image.is_none());
        assert!(FrameFormat::new("cilrs", [(InputKind::Command, Shape::vector(1))]).command);
        assert_eq!(late.split_height_m, 2.0);
        assert_eq!(FrameFormat::new("transfuser", []).split_height_m, -2.0);
    }

    #[test]
    fn a_classifier_reads_one_image_and_gives_a_vector() {
        let camera = (InputKind::Image, Shape::map(32, 32, 3));
        let goal = (InputKind::Goal, Shape::vector(2));
        let classes = |inputs: &[(InputKind, Shape)], output| {
            FrameFormat::new("", inputs.iter().copied()).with_output("x", output).classes
        };
        assert_eq!(classes(&[camera], Some(Shape::vector(10))), Some(10));
        assert_eq!(classes(&[camera], Some(Shape::map(4, 1, 2))), None, "waypoints");
        assert_eq!(classes(&[camera, goal], Some(Shape::vector(10))), None);
        let command = (InputKind::Command, Shape::vector(1));
        assert_eq!(classes(&[camera, command], Some(Shape::vector(3))), None, "controls");
        assert_eq!(classes(&[camera], None), None);
    }
}
