//! A recorded sequence: the route, and what the sensors said in every step.
//!
//! ```text
//! LOG/route.json              {"nodes": [[north_m, east_m], …], "commands": [1..6, …]}, a command per node
//! LOG/frames/<name>/          a folder per step of 1/20 s, in the order of their names
//!     rgb.png                 camera; LBC also reads rgb_left.png and rgb_right.png
//!     lidar.bin               x, y, z, intensity as little-endian f32, for networks that read it
//!     frame.json              {"speed": m/s, "position": [north_m, east_m] or "gps": [latitude, longitude] in degrees,
//!                             "compass": rad, "missing": ["lidar", …], "lidar_axes": …, "lidar_height_m": …}
//! ```
//!
//! `null` stands for a sensor that answered without a number (NaN). A sensor named in `missing` said nothing; it needs no
//! field and no file. `missing` and the two fields of the LiDAR, which mean what they mean in frame directories, may be
//! left out. GPS coordinates become meters as in CARLA from 0.9.10 on.

use firmware::drive::{Command, GpsPlane, Measurements, Position, Reading, Real, RouteNode, Sensor};
use firmware::sensors::lidar::{Axes, Mounting};
use fixed::types::I16F16;
use model_compiler::error::{Error, ErrorCode, Result};
use serde::Deserialize;
use serde_json::Value;
use std::path::{Path, PathBuf};

const ROUTE: &str = "route.json";
const FRAMES: &str = "frames";
const DESCRIPTION: &str = "frame.json";
const ROUTE_HELP: &str = r#"expected {"nodes": [[north_m, east_m], …], "commands": [1..6, …]}, a command per node"#;
const FRAME_HELP: &str = r#"expected {"speed": m/s, "position": [north_m, east_m] or "gps": [latitude, longitude], "compass": rad}, optionally "missing", "lidar_axes", "lidar_height_m""#;

/// Of the sensor that the networks were trained with, m above ground.
const TRAINED_HEIGHT: I16F16 = I16F16::lit("2.5");

/// Names of the sensors in `missing`.
const SENSORS: [(&str, Sensor); 5] = [
    ("camera", Sensor::Camera),
    ("lidar", Sensor::Lidar),
    ("speed", Sensor::Speed),
    ("position", Sensor::Position),
    ("compass", Sensor::Compass),
];

/// A recorded sequence; images and points are read when their step comes.
#[derive(Clone, Debug)]
pub struct Log {
    /// Every node, from start to end.
    pub route: Vec<RouteNode>,
    /// Every step, in order.
    pub frames: Vec<LoggedFrame>,
}

/// One step of a log.
#[derive(Clone, Debug)]
pub struct LoggedFrame {
    /// Name of its folder.
    pub name: String,
    /// The folder.
    pub folder: PathBuf,
    /// What the sensors said, images and points left out.
    pub measurements: Measurements,
    /// How the LiDAR's coordinates lie.
    pub lidar_axes: Axes,
    /// Its height above ground, m.
    pub lidar_height: I16F16,
}

impl Log {
    /// Reads the route and the descriptions of all steps.
    ///
    /// # Errors
    /// A file is missing or damaged, with its field; the route or the sequence is empty.
    pub fn read(folder: &Path) -> Result<Self> {
        let route = read_route(&folder.join(ROUTE))?;
        let frames = folders(&folder.join(FRAMES))?.iter().map(|f| LoggedFrame::read(f)).collect::<Result<_>>()?;
        Ok(Self { route, frames })
    }
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Route {
    nodes: Vec<[f64; 2]>,
    commands: Vec<u8>,
}

fn read_route(path: &Path) -> Result<Vec<RouteNode>> {
    let refuse =
        |message: String| Error::new(ErrorCode::Frames, path.display().to_string(), message).with_help(ROUTE_HELP);
    let bytes = std::fs::read(path).map_err(|e| Error::io(path, &e).with_help(ROUTE_HELP))?;
    let Route { nodes, commands } =
        serde_json::from_slice(&bytes).map_err(|e| refuse(format!("this is no route: {e}")))?;
    if nodes.len() != commands.len() || nodes.is_empty() {
        return Err(refuse(format!("found {} nodes and {} commands", nodes.len(), commands.len())));
    }
    let node = |(index, (&place, &code)): (usize, (&[f64; 2], &u8))| {
        let command = Command::from_code(code)
            .ok_or_else(|| refuse(format!("`commands[{index}]`: found {code}, expected 1..6")))?;
        Ok(RouteNode { position: position(place), command })
    };
    nodes.iter().zip(&commands).enumerate().map(node).collect()
}

/// Folders of the steps, sorted by name.
fn folders(path: &Path) -> Result<Vec<PathBuf>> {
    let entries = std::fs::read_dir(path).map_err(|e| Error::io(path, &e))?;
    let mut folders = Vec::new();
    for entry in entries {
        let entry = entry.map_err(|e| Error::io(path, &e))?;
        if entry.path().is_dir() && !entry.file_name().to_string_lossy().starts_with('.') {
            folders.push(entry.path());
        }
    }
    if folders.is_empty() {
        let error = Error::new(ErrorCode::Frames, path.display().to_string(), "holds no frame folder");
        return Err(error.with_help("expected LOG/frames/<name>/{rgb.png, lidar.bin, frame.json}, one per step"));
    }
    folders.sort();
    Ok(folders)
}

impl LoggedFrame {
    /// How the LiDAR sits on the vehicle.
    pub fn mounting(&self) -> Mounting {
        Mounting::new(self.lidar_axes, self.lidar_height)
    }

    fn read(folder: &Path) -> Result<Self> {
        let description = Description::of_folder(folder)?;
        let place = match description.json.get("gps") {
            None => {
                description.reading(Sensor::Position, "position", "[north_m, east_m]", |v| pair(v).map(position))?
            }
            Some(_) => description.reading(Sensor::Position, "gps", "[latitude, longitude] in degrees", gps)?,
        };
        let (lidar_axes, lidar_height) = description.lidar()?;
        let present = |sensor| if description.missing.contains(&sensor) { Reading::Missing } else { Reading::now(()) };
        Ok(Self {
            name: folder.file_name().unwrap_or_default().to_string_lossy().into_owned(),
            folder: folder.to_path_buf(),
            measurements: Measurements {
                camera: present(Sensor::Camera),
                lidar: present(Sensor::Lidar),
                speed: description.reading(Sensor::Speed, "speed", "m/s", real)?,
                position: place,
                compass: description.reading(Sensor::Compass, "compass", "radians", real)?,
            },
            lidar_axes,
            lidar_height,
        })
    }
}

/// `frame.json`, with the path for messages.
pub(crate) struct Description {
    path: PathBuf,
    json: Value,
    missing: Vec<Sensor>,
}

impl Description {
    /// The description in a frame's folder.
    pub(crate) fn of_folder(folder: &Path) -> Result<Self> {
        Self::read(folder.join(DESCRIPTION))
    }

    fn read(path: PathBuf) -> Result<Self> {
        let text = std::fs::read_to_string(&path).map_err(|e| Error::io(&path, &e).with_help(FRAME_HELP))?;
        let json = serde_json::from_str(&text).map_err(|e| format!("not JSON: {e}"));
        let json = json.and_then(|json: Value| if json.is_object() { Ok(json) } else { Err("no JSON object".into()) });
        let json = json.map_err(|message| {
            Error::new(ErrorCode::Frames, path.display().to_string(), message).with_help(FRAME_HELP)
        })?;
        let mut description = Self { path, json, missing: Vec::new() };
        description.missing = description.missing()?;
        Ok(description)
    }

    fn missing(&self) -> Result<Vec<Sensor>> {
        let known = |name: &Value| SENSORS.iter().find(|(known, _)| name == known).map(|&(_, sensor)| sensor);
        let expected = "a list of \"camera\", \"lidar\", \"speed\", \"position\", \"compass\"";
        match self.json.get("missing") {
            None => Ok(Vec::new()),
            Some(list) => {
                let sensors = list.as_array().and_then(|names| names.iter().map(known).collect());
                sensors.ok_or_else(|| self.bad("missing", expected))
            }
        }
    }

    fn reading<T>(
        &self,
        sensor: Sensor,
        field: &str,
        expected: &str,
        read: impl Fn(&Value) -> Option<T>,
    ) -> Result<Reading<T>> {
        if self.missing.contains(&sensor) {
            return Ok(Reading::Missing);
        }
        match self.json.get(field) {
            Some(Value::Null) => Ok(Reading::NotANumber),
            Some(value) => read(value).map(Reading::now).ok_or_else(|| self.bad(field, expected)),
            None => Err(self.bad(field, expected)),
        }
    }

    /// Goal `[right, forward]`, m, where there is one.
    pub(crate) fn goal(&self) -> Option<[f64; 2]> {
        pair(self.json.get("goal")?)
    }

    /// Axes of the LiDAR and its height, m.
    pub(crate) fn lidar(&self) -> Result<(Axes, I16F16)> {
        let axes = match self.json.get("lidar_axes").filter(|v| !v.is_null()).map(Value::as_str) {
            None | Some(Some("carla")) => Axes::Carla,
            Some(Some("velodyne")) => Axes::Velodyne,
            _ => return Err(self.bad("lidar_axes", "\"carla\" or \"velodyne\"")),
        };
        let height = match self.json.get("lidar_height_m").filter(|v| !v.is_null()) {
            None => Some(TRAINED_HEIGHT),
            Some(height) => height.as_f64().and_then(I16F16::checked_from_num),
        };
        Ok((axes, height.ok_or_else(|| self.bad("lidar_height_m", "meters"))?))
    }

    fn bad(&self, field: &str, expected: &str) -> Error {
        let found = self.json.get(field).map_or_else(|| "missing".to_owned(), |value| format!("found {value}"));
        let message = format!("`{field}`: {found}, expected {expected}");
        Error::new(ErrorCode::Frames, self.path.display().to_string(), message).with_help(FRAME_HELP)
    }
}

fn real(value: &Value) -> Option<Real> {
    value.as_f64().map(Real::saturating_from_num)
}

fn pair(value: &Value) -> Option<[f64; 2]> {
    match value.as_array()?.as_slice() {
        [a, b] => Some([a.as_f64()?, b.as_f64()?]),
        _ => None,
    }
}

fn position([north, east]: [f64; 2]) -> Position {
    Position { north: Real::saturating_from_num(north), east: Real::saturating_from_num(east) }
}

fn gps(value: &Value) -> Option<Position> {
    // A cast saturates; coordinates have ten digits at most.
    let [latitude, longitude] = pair(value)?.map(|degrees| (degrees * 1e9).round() as i64);
    Some(GpsPlane::CARLA.position(latitude, longitude))
}
