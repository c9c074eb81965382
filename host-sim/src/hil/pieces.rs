//! From the files of a moment to the messages that carry them: rows of images, points, tensors.

use crate::drive::log::{Description, LoggedFrame};
use firmware::drive::{Command, Measurements, NetworkInputs, Reading};
use firmware::image::Image;
use firmware::link::{CameraSetup, End, MAX_PIECE, Request};
use firmware::sensors::camera::{PixelFormat, Scale};
use firmware::sensors::lidar::Axes;
use firmware::sensors::views::View;
use firmware::tensor::Shape;
use fixed::types::{I8F8, I16F16};
use image::RgbImage;
use model_compiler::error::{Error, ErrorCode, Result};
use model_compiler::frames::{Frame, camera};
use model_compiler::integer_reference::encode_input;
use model_compiler::ir::InputKind;
use std::path::Path;

/// Files of the cameras, in the order of [`View::LBC`].
const CAMERAS: [&str; 3] = ["rgb.png", "rgb_left.png", "rgb_right.png"];
const LIDAR: &str = "lidar.bin";
/// Red, green, blue.
const PIXEL_BYTES: usize = 3;
/// x, y, z, intensity as little-endian f32; the last stays here.
const RECORD_BYTES: usize = 16;
const POINT_BYTES: usize = 12;

/// A part of a frame, with the fields of its message.
#[derive(Clone, Debug, PartialEq, Eq)]
#[allow(missing_docs, reason = "see `Request`")]
pub enum Piece {
    /// See [`Request::Row`].
    Row { view: View, row: u16, offset: u32, bytes: Vec<u8> },
    /// See [`Request::Points`].
    Points(Vec<u8>),
    /// See [`Request::Input`].
    Input { input: u8, offset: u32, bytes: Vec<u8> },
}

impl Piece {
    /// As a message.
    pub fn request(&self) -> Request<'_> {
        match self {
            Self::Row { view, row, offset, bytes } => Request::Row { view: *view, row: *row, offset: *offset, bytes },
            Self::Points(bytes) => Request::Points(bytes),
            Self::Input { input, offset, bytes } => Request::Input { input: *input, offset: *offset, bytes },
        }
    }

    /// For messages.
    pub fn name(&self) -> String {
        match self {
            Self::Row { view, row, offset, .. } => format!("row {row} of camera {view:?} from byte {offset} on"),
            Self::Points(bytes) => format!("{} LiDAR points", bytes.len() / POINT_BYTES),
            Self::Input { input, offset, .. } => format!("input {input} from byte {offset} on"),
        }
    }
}

/// What a moment says about the sensors; `None` where it has nothing of theirs.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Setup {
    /// Columns and rows of the cameras' images.
    pub image: Option<[u16; 2]>,
    /// Axes of the LiDAR, and its height, m.
    pub lidar: Option<(Axes, I16F16)>,
}

impl Setup {
    /// This, and what only the other one says.
    #[must_use]
    pub fn or(self, other: Self) -> Self {
        Self { image: self.image.or(other.image), lidar: self.lidar.or(other.lidar) }
    }

    /// Whether nothing is left to know.
    pub const fn is_whole(self) -> bool {
        self.image.is_some() && self.lidar.is_some()
    }

    /// Whether a board that is set up so can take a moment that needs `other`.
    pub fn serves(self, other: Self) -> bool {
        other.or(self) == self
    }
}

/// One moment as a board is told it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Parcel {
    /// What the sensors must be for it.
    pub setup: Setup,
    /// Its data.
    pub pieces: Vec<Piece>,
    /// What is to be done with them.
    pub end: End,
}

/// What an image reads, as far as sensors are concerned.
#[derive(Clone, Copy, Debug)]
pub struct Reads {
    /// The map that cameras fill, and whether three of them do.
    camera: Option<(Shape, bool)>,
    lidar: bool,
}

impl Reads {
    /// Of an image's inputs.
    pub fn of_image(image: &Image<'_>) -> Self {
        let ports = || (0..image.input_count()).filter_map(|index| image.input(index));
        let shape = |name: &str| {
            ports().find(|port| port.name == name).and_then(|port| image.tensor(port.tensor)).map(|record| record.shape)
        };
        let views = shape("views").map(|shape| (shape, true));
        let camera = views.or_else(|| shape("rgb").map(|shape| (shape, false)));
        let lidar = ports().any(|port| matches!(port.name, "bev" | "bev_points" | "cam_points"));
        Self { camera, lidar }
    }

    /// The cameras as a board is to know them. They are never taken for frozen: recordings of a standing vehicle repeat
    /// their images. Without an image its size is the network's.
    pub fn camera(&self, setup: Setup) -> CameraSetup {
        let map = self.camera.map_or(Shape::map(1, 1, 3), |(shape, _)| shape);
        let [width, height] = setup.image.unwrap_or([map.width, map.height]);
        let format = if map.channels == 1 { PixelFormat::Grey } else { PixelFormat::Rgb };
        CameraSetup { width, height, format, scale: Scale::Full, frozen_after: 0 }
    }

    /// Sensor data of a frame folder; the network runs on exactly this speed, goal and command.
    ///
    /// # Errors
    /// A file is missing or damaged.
    pub fn frame(&self, folder: &Path, frame: &Frame) -> Result<Parcel> {
        let description = Description::of_folder(folder)?;
        let mut pieces = Vec::new();
        let image = self.rows(folder, &mut pieces)?;
        let lidar = self.lidar.then(|| description.lidar()).transpose()?;
        if self.lidar {
            points(&folder.join(LIDAR), &mut pieces)?;
        }
        // In the file forward is positive; in the network's frame it is negative.
        let goal = description.goal().map_or([0.0; 2], |[right, forward]| [right, 0.0 - forward]);
        let end = End::Infer(Some(network_inputs(frame, goal)));
        Ok(Parcel { setup: Setup { image, lidar }, pieces, end })
    }

    /// A step of a log.
    ///
    /// # Errors
    /// A file of a sensor that is not missing is, or is damaged.
    pub fn step(&self, frame: &LoggedFrame) -> Result<Parcel> {
        let Measurements { camera, lidar, .. } = frame.measurements;
        let (mut pieces, mut setup) = (Vec::new(), Setup::default());
        if is_there(camera) {
            setup.image = self.rows(&frame.folder, &mut pieces)?;
        }
        if self.lidar && is_there(lidar) {
            setup.lidar = Some((frame.lidar_axes, frame.lidar_height));
            points(&frame.folder.join(LIDAR), &mut pieces)?;
        }
        Ok(Parcel { setup, pieces, end: End::Drive(frame.measurements) })
    }

    /// Rows of all cameras, as far as the crop needs them; the images' size.
    fn rows(&self, folder: &Path, pieces: &mut Vec<Piece>) -> Result<Option<[u16; 2]>> {
        let Some((crop, has_views)) = self.camera else { return Ok(None) };
        let mut size = None;
        for (view, file) in View::LBC.into_iter().zip(CAMERAS).take(if has_views { CAMERAS.len() } else { 1 }) {
            let path = folder.join(file);
            let image = camera::decode(&path)?;
            let found = sides(&image, &path)?;
            let expected = *size.get_or_insert(found);
            if found != expected {
                let [found, expected] = [found, expected].map(|[w, h]| format!("{w}×{h}"));
                let message = format!("the image is {found}, the first camera's {expected}");
                return Err(Error::new(ErrorCode::Frames, path.display().to_string(), message)
                    .with_help("all cameras of a vehicle are alike"));
            }
            cut(&image, view, crop, pieces);
        }
        Ok(size)
    }
}

/// The network's inputs themselves, in place of what sensors would give.
pub fn inputs(inputs: &[Vec<u8>]) -> Parcel {
    let piece = |input: usize, (number, bytes): (usize, &[u8])| Piece::Input {
        input: u8::try_from(input).unwrap_or(u8::MAX),
        offset: (number * MAX_PIECE) as u32,
        bytes: bytes.to_vec(),
    };
    let pieces = inputs.iter().enumerate();
    let pieces =
        pieces.flat_map(|(input, bytes)| bytes.chunks(MAX_PIECE).enumerate().map(move |part| piece(input, part)));
    Parcel { setup: Setup::default(), pieces: pieces.collect(), end: End::Infer(None) }
}

/// Speed, goal and command in the codes of the network's inputs. What the frame does not tell is zero, or to follow the
/// lane.
fn network_inputs(frame: &Frame, goal: [f64; 2]) -> NetworkInputs {
    let codes =
        |kind, values: &[f64]| encode_input(kind, &values.iter().map(|&v| f64::from(v as f32)).collect::<Vec<_>>());
    let goal = codes(InputKind::Goal, &goal);
    let velocity = codes(InputKind::Velocity, &[frame.speed.unwrap_or_default()]);
    NetworkInputs {
        goal: [0, 1].map(|axis| I16F16::from_bits(goal[axis] as i32)),
        velocity: I8F8::from_bits(velocity[0] as i16),
        command: frame.command.and_then(Command::from_code).unwrap_or(Command::LaneFollow),
    }
}

const fn is_there(reading: Reading<()>) -> bool {
    matches!(reading, Reading::Value { .. })
}

fn sides(image: &RgbImage, path: &Path) -> Result<[u16; 2]> {
    let side = |side: u32| u16::try_from(side).ok();
    let sides = side(image.width()).zip(side(image.height()));
    sides.map(|(width, height)| [width, height]).ok_or_else(|| {
        let message = format!("the image is {}×{}, a side is at most {}", image.width(), image.height(), u16::MAX);
        Error::new(ErrorCode::Frames, path.display().to_string(), message)
    })
}

/// The part of an image that the crop at its center needs, piece by piece. Of a smaller image that is all of it; the
/// board then says what it lacks.
fn cut(image: &RgbImage, view: View, crop: Shape, pieces: &mut Vec<Piece>) {
    let [width, height] = [image.width() as usize, image.height() as usize];
    let span =
        |whole: usize, part: usize| whole.saturating_sub(part) / 2..(whole.saturating_sub(part) / 2 + part).min(whole);
    let (rows, columns) = (span(height, crop.height.into()), span(width, crop.width.into()));
    let row_bytes = columns.start * PIXEL_BYTES..columns.end * PIXEL_BYTES;
    for row in rows {
        let bytes = &image.as_raw()[row * width * PIXEL_BYTES..][row_bytes.clone()];
        // A piece holds whole pixels.
        let parts = bytes.chunks(MAX_PIECE / PIXEL_BYTES * PIXEL_BYTES);
        let mut offset = row_bytes.start;
        for part in parts {
            pieces.push(Piece::Row { view, row: row as u16, offset: offset as u32, bytes: part.to_vec() });
            offset += part.len();
        }
    }
}

/// The points of a sweep; a sweep without any is one message without any.
fn points(path: &Path, pieces: &mut Vec<Piece>) -> Result<()> {
    let bytes = std::fs::read(path).map_err(|e| Error::io(path, &e))?;
    let (records, rest) = bytes.as_chunks::<RECORD_BYTES>();
    if !rest.is_empty() {
        let message =
            format!("{} bytes, expected a multiple of {RECORD_BYTES} (x, y, z, intensity as f32)", bytes.len());
        return Err(Error::new(ErrorCode::Frames, path.display().to_string(), message).with_help("is it truncated?"));
    }
    let points: Vec<u8> = records.iter().flat_map(|record| &record[..POINT_BYTES]).copied().collect();
    if points.is_empty() {
        pieces.push(Piece::Points(Vec::new()));
    }
    pieces.extend(points.chunks(MAX_PIECE / POINT_BYTES * POINT_BYTES).map(|part| Piece::Points(part.to_vec())));
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_what_the_crop_needs_is_sent_in_whole_pixels() {
        let image = RgbImage::from_fn(702, 9, |x, y| image::Rgb([x as u8, (x >> 8) as u8, y as u8]));
        let mut pieces = Vec::new();
        cut(&image, View::Left, Shape::map(4, 700, 10), &mut pieces);
        // 700 pixels are 2100 bytes, from byte 3 on; rows 2 to 5 of 9.
        let found = pieces.iter().map(|piece| match piece {
            Piece::Row { view: View::Left, row, offset, bytes } => (*row, *offset, bytes.len(), bytes[2]),
            other => panic!("{other:?}"),
        });
        let row = |row: u16| [(row, 3, 960, row as u8), (row, 963, 960, row as u8), (row, 1923, 180, row as u8)];
        assert_eq!(found.collect::<Vec<_>>(), (2..6).flat_map(row).collect::<Vec<_>>());
        pieces.clear();
        cut(&image, View::Front, Shape::map(256, 1000, 3), &mut pieces);
        assert_eq!(pieces.len(), 9 * 3, "of a smaller image all that there is");
    }

    #[test]
    fn points_leave_their_intensity_behind_and_an_empty_sweep_is_told() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join(LIDAR);
        let sent = |count: u8| {
            std::fs::write(&path, (0..count).flat_map(|point| [point; RECORD_BYTES]).collect::<Vec<_>>()).unwrap();
            let mut pieces = Vec::new();
            points(&path, &mut pieces).map(|()| pieces)
        };
        assert_eq!(sent(0).unwrap(), [Piece::Points(Vec::new())]);
        let pieces = sent(100).unwrap();
        assert_eq!(pieces.iter().map(Piece::name).collect::<Vec<_>>(), ["80 LiDAR points", "20 LiDAR points"]);
        assert_eq!(pieces[1], Piece::Points((80..100).flat_map(|point| [point; POINT_BYTES]).collect()));
        std::fs::write(&path, [0; 17]).unwrap();
        assert!(points(&path, &mut Vec::new()).unwrap_err().message.contains("expected a multiple of 16"));
    }

    #[test]
    fn inputs_go_piece_by_piece_from_their_beginning() {
        let parcel = inputs(&[vec![1; 2000], vec![2; 3]]);
        let sizes = parcel.pieces.iter().map(|piece| match piece {
            Piece::Input { input, offset, bytes } => (*input, *offset, bytes.len()),
            other => panic!("{other:?}"),
        });
        assert_eq!(sizes.collect::<Vec<_>>(), [(0, 0, 960), (0, 960, 960), (0, 1920, 80), (1, 0, 3)]);
        assert_eq!(parcel.end, End::Infer(None));
    }

    #[test]
    fn a_board_serves_what_it_was_set_up_for_and_what_says_nothing() {
        let (small, large) = (Some([4, 3]), Some([40, 30]));
        let lidar = Some((Axes::Velodyne, I16F16::lit("1.5")));
        let setup = Setup { image: small, lidar };
        assert!(
            setup.serves(Setup::default()) && setup.serves(Setup { image: small, lidar: None }) && setup.is_whole()
        );
        assert!(!setup.serves(Setup { image: large, lidar: None }));
        assert!(!Setup { image: small, lidar: None }.serves(setup));
    }

    #[test]
    fn speed_goal_and_command_are_rounded_as_the_networks_inputs() {
        let frame = Frame { speed: Some(1.001), command: Some(2), ..Frame::default() };
        let inputs = network_inputs(&frame, [0.5, -20.0]);
        assert_eq!((inputs.velocity.to_bits(), inputs.command), (256, Command::Right));
        assert_eq!(inputs.goal.map(I16F16::to_bits), [32768, -1_310_720]);
        let nothing = network_inputs(&Frame::default(), [0.0; 2]);
        assert_eq!((nothing.velocity.to_bits(), nothing.command), (0, Command::LaneFollow));
    }
}
