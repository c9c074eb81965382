//! Frame directories: one folder per frame with camera images, LiDAR points and a small description.

use super::{Frame, FrameFormat, RealMap, bev, camera, correspondence, views};
use crate::error::{Error, ErrorCode, Result};
use bev::LidarAxes;
use firmware::tensor::Shape;
use serde_json::Value;
use std::path::{Path, PathBuf};

const IMAGE: &str = "rgb.png";
/// The cameras of LBC: front, left, right.
const VIEWS: [&str; 3] = [IMAGE, "rgb_left.png", "rgb_right.png"];
const LIDAR: &str = "lidar.bin";
const DESCRIPTION: &str = "frame.json";
const DESCRIPTION_HELP: &str = concat!(
    r#"fields, as far as the network reads them: "speed": m/s, "goal": [right_m, forward_m], "command": 1..6; "#,
    r#"optionally "lidar_axes", "lidar_height_m""#
);
/// x, y, z, intensity as little-endian f32.
const POINT_BYTES: usize = 16;

/// Loads every folder of `path`, sorted by name.
pub(super) fn load(path: &Path, format: &FrameFormat) -> Result<Vec<Frame>> {
    let folders = frame_folders(path)?;
    if folders.is_empty() {
        let error = Error::new(ErrorCode::Frames, path.display().to_string(), "holds no frame folder");
        return Err(error.with_help(
            "expected FRAMES/<name>/{rgb.png, rgb_left.png, rgb_right.png (lbc), lidar.bin, frame.json}; give the \
             folder above",
        ));
    }
    folders.iter().map(|folder| load_frame(folder, format)).collect()
}

fn frame_folders(path: &Path) -> Result<Vec<PathBuf>> {
    let mut folders = Vec::new();
    for entry in std::fs::read_dir(path).map_err(|e| Error::io(path, &e))? {
        let entry = entry.map_err(|e| Error::io(path, &e))?;
        let hidden = entry.file_name().to_string_lossy().starts_with('.');
        if entry.path().is_dir() && !hidden {
            folders.push(entry.path());
        }
    }
    folders.sort();
    Ok(folders)
}

fn load_frame(folder: &Path, format: &FrameFormat) -> Result<Frame> {
    let description = Description::read(&folder.join(DESCRIPTION))?;
    if let Some(shape) = format.bev.filter(|shape| !bev::is_possible(*shape)) {
        return Err(wrong_histogram_size(folder, shape));
    }
    if let Some(shape) = format.points.filter(|shape| !correspondence::is_possible(*shape)) {
        return Err(wrong_grid(folder, shape));
    }
    let reads_points = format.bev.is_some() || format.points.is_some();
    let points = reads_points.then(|| read_points(&folder.join(LIDAR), &description)).transpose()?;
    let points = || points.iter().flatten().copied();
    let (bev, dropped_points) = match format.bev.map(|shape| bev::histogram(points(), format.split_height_m, shape)) {
        Some((map, dropped)) => (Some(map), dropped),
        None => (None, 0),
    };
    let correspondence = format.points.map(|shape| correspondence::correspondence(points(), shape));
    let (bev_points, camera_points) = correspondence.map(|lists| (lists.bev, lists.camera)).unzip();
    Ok(Frame {
        name: folder.file_name().unwrap_or_default().to_string_lossy().into_owned(),
        rgb: format.image.map(|shape| camera::load(&folder.join(IMAGE), shape)).transpose()?,
        bev,
        velocity: format.velocity.then(|| description.number("speed")).transpose()?,
        goal: format.goal.then(|| description.goal()).transpose()?,
        views: format.views.map(|shape| read_views(folder, shape, &description)).transpose()?,
        command: description.command(format.command)?,
        bev_points,
        camera_points,
        dropped_points,
        label: None,
        speed: as_f32_range(&description.json["speed"]),
    })
}

/// The views of LBC, cropped to the network's size, and the heatmap of the goal.
fn read_views(folder: &Path, shape: Shape, description: &Description) -> Result<RealMap> {
    if shape.channels != views::CHANNELS {
        let message = format!(
            "the network reads {} channels, frame folders give {}: three views and a heatmap",
            shape.channels,
            views::CHANNELS
        );
        return Err(only_tensors(folder, message));
    }
    let load = |file: &str| camera::load(&folder.join(file), Shape::map(shape.height, shape.width, 3));
    let [front, left, right] = VIEWS.map(load);
    Ok(views::join(&[front?, left?, right?], description.goal()?))
}

fn wrong_histogram_size(folder: &Path, shape: Shape) -> Error {
    let message = format!(
        "the network reads a {}×{}×{} histogram, frame folders give powers of two up to 1024 and 2 channels",
        shape.height, shape.width, shape.channels
    );
    only_tensors(folder, message)
}

fn wrong_grid(folder: &Path, shape: Shape) -> Error {
    let message = format!(
        "the network gathers {}×{} cells by {} numbers each, frame folders give pairs for 1×1 to 9×9 cells",
        shape.height, shape.width, shape.channels
    );
    only_tensors(folder, message)
}

/// Frame folders cannot give what the network reads.
fn only_tensors(folder: &Path, message: String) -> Error {
    Error::new(ErrorCode::Frames, folder.display().to_string(), message).with_help("feed it with a .safetensors file")
}

fn read_points(path: &Path, description: &Description) -> Result<Vec<bev::Point>> {
    let bytes = std::fs::read(path).map_err(|e| Error::io(path, &e))?;
    if bytes.len() % POINT_BYTES != 0 {
        let message =
            format!("{} bytes, expected a multiple of {POINT_BYTES} (x, y, z, intensity as f32)", bytes.len());
        return Err(Error::new(ErrorCode::Frames, path.display().to_string(), message).with_help("is it truncated?"));
    }
    let axes = description.axes()?;
    let height_m = description.number_or("lidar_height_m", bev::SENSOR_HEIGHT_M)?;
    let coordinate = |point: &[u8], i: usize| f32::from_le_bytes([0, 1, 2, 3].map(|byte| point[4 * i + byte]));
    let raw = bytes.chunks_exact(POINT_BYTES).map(|point| [0, 1, 2].map(|i| coordinate(point, i)));
    Ok(raw.map(|point| axes.to_trained_frame(point, height_m)).collect())
}

/// `frame.json`, with the path for messages.
struct Description {
    path: PathBuf,
    json: Value,
}

impl Description {
    fn read(path: &Path) -> Result<Self> {
        let text = std::fs::read_to_string(path).map_err(|e| Error::io(path, &e))?;
        let refuse = |message: String| {
            Error::new(ErrorCode::Frames, path.display().to_string(), message).with_help(DESCRIPTION_HELP)
        };
        let json: Value = serde_json::from_str(&text).map_err(|e| refuse(format!("not JSON: {e}")))?;
        if !json.is_object() {
            return Err(refuse("found no JSON object".into()));
        }
        Ok(Self { path: path.to_path_buf(), json })
    }

    fn number(&self, field: &str) -> Result<f64> {
        as_f32_range(&self.json[field]).ok_or_else(|| self.bad(field, "a number"))
    }

    fn number_or(&self, field: &str, default: f64) -> Result<f64> {
        if self.json[field].is_null() { Ok(default) } else { self.number(field) }
    }

    /// In the file forward is positive; in the network's frame it is negative.
    fn goal(&self) -> Result<[f64; 2]> {
        match self.json["goal"].as_array().map(|a| a.iter().map(as_f32_range).collect::<Vec<_>>()).as_deref() {
            Some([Some(right), Some(forward)]) => Ok([*right, 0.0 - forward]),
            _ => Err(self.bad("goal", "[right_m, forward_m]")),
        }
    }

    fn command(&self, needed: bool) -> Result<Option<u8>> {
        match &self.json["command"] {
            Value::Null if !needed => Ok(None),
            value => match value.as_u64() {
                Some(command @ 1..=6) => Ok(Some(command as u8)),
                _ => Err(self.bad("command", "1..6")),
            },
        }
    }

    fn axes(&self) -> Result<LidarAxes> {
        match &self.json["lidar_axes"] {
            Value::Null => Ok(LidarAxes::Carla),
            Value::String(name) if name == "carla" => Ok(LidarAxes::Carla),
            Value::String(name) if name == "velodyne" => Ok(LidarAxes::Velodyne),
            _ => Err(self.bad("lidar_axes", "\"carla\" or \"velodyne\"")),
        }
    }

    fn bad(&self, field: &str, expected: &str) -> Error {
        let found = match &self.json[field] {
            Value::Null => "missing".to_owned(),
            value => format!("found {value}"),
        };
        Error::new(
            ErrorCode::Frames,
            self.path.display().to_string(),
            format!("`{field}`: {found}, expected {expected}"),
        )
        .with_help(DESCRIPTION_HELP)
    }
}

/// A number that stays finite as f32, which is what the networks read.
fn as_f32_range(value: &Value) -> Option<f64> {
    value.as_f64().filter(|v| (*v as f32).is_finite())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ir::InputKind;
    use std::fs;

    const GOOD: &str = r#"{"speed": 4.5, "goal": [1.5, 25], "command": 4}"#;

    fn format(system: &str, image: u16) -> FrameFormat {
        let inputs = [
            (InputKind::Image, Shape::map(image, image, 3)),
            (InputKind::Bev, bev::SHAPE),
            (InputKind::Velocity, Shape::vector(1)),
            (InputKind::Goal, Shape::vector(2)),
        ];
        FrameFormat::new(system, inputs)
    }

    /// A directory of one frame: a 4×4 image, one point 10 m ahead and 1 m to the left, 0.2 m above ground.
    fn directory(json: &str) -> tempfile::TempDir {
        let root = tempfile::tempdir().unwrap();
        let folder = root.path().join("one");
        fs::create_dir(&folder).unwrap();
        image::RgbImage::from_fn(4, 4, |x, y| image::Rgb([x as u8, y as u8, 9])).save(folder.join(IMAGE)).unwrap();
        let point = [1.0_f32, 10.0, -2.3, 0.5];
        fs::write(folder.join(LIDAR), point.map(f32::to_le_bytes).concat()).unwrap();
        fs::write(folder.join(DESCRIPTION), json).unwrap();
        root
    }

    #[test]
    fn a_frame_folder_becomes_network_inputs() {
        let root = directory(GOOD);
        let frames = load(root.path(), &format("transfuser", 2)).unwrap();
        assert_eq!(frames.len(), 1);
        let frame = &frames[0];
        assert_eq!((frame.name.as_str(), frame.velocity, frame.command), ("one", Some(4.5), Some(4)));
        assert_eq!(frame.speed, frame.velocity);
        assert_eq!(frame.goal, Some([1.5, -25.0]), "forward is negative in the network's frame");
        assert_eq!(frame.rgb.as_ref().unwrap().data, [1, 1, 9, 2, 1, 9, 1, 2, 9, 2, 2, 9]);
        let bev = &frame.bev.as_ref().unwrap().data;
        let (row, column) = ((33.0 / (65.0 / 256.0)) as usize, (22.0 / 0.125) as usize);
        assert_eq!(bev[(row * 256 + column) * 2], 1);
        assert_eq!(bev.iter().filter(|&&c| c > 0).count(), 1);
    }

    #[test]
    fn axes_and_height_of_the_description_are_used() {
        let json = r#"{"speed": 0, "goal": [0, 1], "lidar_axes": "velodyne", "lidar_height_m": 3.0}"#;
        let frames = load(directory(json).path(), &format("transfuser", 4)).unwrap();
        let bev = &frames[0].bev.as_ref().unwrap().data;
        // Forward 1 m, left 10 m, 0.7 m above ground: the upper channel.
        let (row, column) = ((42.0 / (65.0 / 256.0)) as usize, (31.0 / 0.125) as usize);
        assert_eq!(bev[(row * 256 + column) * 2 + 1], 1);
    }

    #[test]
    fn cells_that_see_the_same_points_come_from_the_same_sweep() {
        let points = |side: u16| {
            let cells = (InputKind::BevPoints, Shape::map(side, side, 10));
            let inputs = [cells, (InputKind::CameraPoints, cells.1), (InputKind::Goal, Shape::vector(2))];
            load(directory(GOOD).path(), &FrameFormat::new("geometric_fusion", inputs))
        };
        let frame = points(8).unwrap().remove(0);
        let cells = |map: &Option<super::super::ByteMap>| {
            map.as_ref()
                .unwrap()
                .data
                .iter()
                .enumerate()
                .filter(|(_, v)| **v != 0)
                .map(|(i, &v)| (i, v))
                .collect::<Vec<_>>()
        };
        // The point lies in LiDAR cell (4, 2) and image cell (4, 5).
        assert_eq!(cells(&frame.bev_points), [(340, 4), (341, 5)]);
        assert_eq!(cells(&frame.camera_points), [(370, 4), (371, 2)]);
        assert!(frame.bev.is_none());
        let message = points(16).unwrap_err().to_string();
        assert!(message.contains("gathers 16×16 cells by 10 numbers each"), "{message}");
    }

    #[test]
    fn unusable_frames_are_refused_by_file_and_field() {
        let cases = [
            (r#"{"goal": [1, 2]}"#, "frame.json: `speed`: missing, expected a number"),
            (r#"{"speed": "fast", "goal": [1, 2]}"#, "`speed`: found \"fast\", expected a number"),
            (r#"{"speed": 1, "goal": [1]}"#, "`goal`: found [1], expected [right_m, forward_m]"),
            (r#"{"speed": 1, "goal": [1, 2], "command": 7}"#, "`command`: found 7, expected 1..6"),
            (r#"{"speed": 1, "goal": [1, 2], "lidar_axes": "ouster"}"#, "`lidar_axes`: found \"ouster\""),
            (r#"{"speed": 1e39, "goal": [1, 2]}"#, "`speed`: found 1e+39, expected a number"),
            ("{", "frame.json: not JSON"),
        ];
        for (json, expected) in cases {
            let message = load(directory(json).path(), &format("transfuser", 4)).unwrap_err().to_string();
            assert!(message.contains(expected), "{json}: {message}");
        }
    }

    #[test]
    fn missing_and_damaged_files_are_named() {
        let message = |damage: &dyn Fn(&Path)| {
            let root = directory(GOOD);
            damage(&root.path().join("one"));
            load(root.path(), &format("transfuser", 4)).unwrap_err().to_string()
        };
        let lidar_cut = message(&|folder| fs::write(folder.join(LIDAR), [0; 31]).unwrap());
        assert!(lidar_cut.contains("lidar.bin: 31 bytes, expected a multiple of 16"), "{lidar_cut}");
        let no_image = message(&|folder| fs::write(folder.join(IMAGE), b"hello").unwrap());
        assert!(no_image.contains("rgb.png: "), "{no_image}");
        for file in [IMAGE, LIDAR, DESCRIPTION] {
            let gone = message(&|folder| fs::remove_file(folder.join(file)).unwrap());
            assert!(gone.contains(file), "{gone}");
        }
        let empty = load(tempfile::tempdir().unwrap().path(), &format("transfuser", 4)).unwrap_err().to_string();
        assert!(empty.contains("holds no frame folder"), "{empty}");
    }

    #[test]
    fn only_what_the_network_reads_has_to_be_there() {
        let root = directory(r#"{"goal": [0, 3]}"#);
        fs::remove_file(root.path().join("one").join(LIDAR)).unwrap();
        let aim =
            FrameFormat::new("aim", [(InputKind::Image, Shape::map(4, 4, 3)), (InputKind::Goal, Shape::vector(2))]);
        let frame = load(root.path(), &aim).unwrap().remove(0);
        assert!(frame.bev.is_none() && frame.velocity.is_none() && frame.command.is_none());
        let message = load(root.path(), &FrameFormat { command: true, ..aim }).unwrap_err().to_string();
        assert!(message.contains("frame.json: `command`: missing, expected 1..6"), "{message}");
    }

    #[test]
    fn a_speed_that_no_network_reads_is_kept_where_it_is_one() {
        let aim = FrameFormat::new("aim", [(InputKind::Image, Shape::map(4, 4, 3))]);
        let speeds = [
            (r#"{"speed": 4.5}"#, Some(4.5)),
            ("{}", None),
            (r#"{"speed": "fast"}"#, None),
            (r#"{"speed": 1e39}"#, None),
        ];
        let frames = speeds.map(|(json, speed)| (load(directory(json).path(), &aim).unwrap().remove(0), speed));
        for (frame, speed) in &frames {
            assert_eq!((frame.speed, frame.velocity), (*speed, None));
            assert_eq!(frame.digest(), frames[1].0.digest(), "a digest is of what the network reads");
        }
    }

    #[test]
    fn the_views_of_lbc_are_joined_with_the_heatmap_of_the_goal() {
        let root = directory(r#"{"goal": [0, 1]}"#);
        let folder = root.path().join("one");
        let save = |file: &str, level: u8| {
            image::RgbImage::from_pixel(4, 4, image::Rgb([level; 3])).save(folder.join(file)).unwrap();
        };
        save(VIEWS[1], 50);
        let lbc = |channels| FrameFormat::new("lbc", [(InputKind::Views, Shape::map(2, 4, channels))]);
        let message = load(root.path(), &lbc(10)).unwrap_err().to_string();
        assert!(message.contains("rgb_right.png"), "{message}");
        save(VIEWS[2], 70);
        let frame = load(root.path(), &lbc(10)).unwrap().remove(0);
        let views = frame.views.as_ref().unwrap();
        // The second row of four; the target is below and to the right of the last pixel.
        assert_eq!(views.data[..9], [0.0, 1.0, 9.0, 50.0, 50.0, 50.0, 70.0, 70.0, 70.0]);
        assert_eq!(views.data[79], 255.0);
        assert_eq!((frame.rgb.is_none(), frame.raw(InputKind::Views).unwrap().len()), (true, 80));
        let message = load(root.path(), &lbc(9)).unwrap_err().to_string();
        assert!(message.contains("the network reads 9 channels, frame folders give 10"), "{message}");
    }

    /// Another axis convention and sensor height, the same scene: the golden histogram was made from this very sweep.
    #[test]
    fn a_real_sweep_gives_the_golden_histogram() {
        let workspace_neighbor = || Path::new(env!("CARGO_MANIFEST_DIR")).join("../../shared");
        let shared = std::env::var_os("SHARED_DIR").map_or_else(workspace_neighbor, PathBuf::from);
        let (sweeps, golden) = (shared.join("data/kitti"), shared.join("golden/bev.safetensors"));
        let (true, Ok(golden)) = (sweeps.is_dir(), fs::read(golden)) else {
            println!("not run: shared/data/kitti or shared/golden/bev.safetensors is absent");
            return;
        };
        let frame = load(&sweeps, &format("transfuser", 256)).unwrap().remove(0);
        let counts = safetensors::SafeTensors::deserialize(&golden).unwrap();
        assert!(frame.bev.unwrap().data == counts.tensor("bev_counts").unwrap().data());
        assert_eq!(frame.goal, Some([1.5, -25.0]));
    }
}
