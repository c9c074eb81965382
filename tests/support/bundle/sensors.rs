//! Camera and LiDAR in a scene, and the files of a frame.

use super::scene::{Random, Scene, Vector};
use model_compiler::frames::bev::{self, LidarAxes, SENSOR_HEIGHT_M};
use model_compiler::frames::{ByteMap, Frame};
use model_compiler::ir::Shape;
use serde_json::json;
use std::fs;
use std::path::Path;

/// Pixels of the image, bins of the histogram.
const SIDE: u16 = 128;
/// Focal length in pixels: the field of view of the published networks' camera crop.
const FOCAL: f64 = 84.0;
const CAMERA: Vector = [0.0, 1.3, 2.3];
const LIDAR: Vector = [0.0, 0.0, SENSOR_HEIGHT_M];
const RINGS: u32 = 24;
const RAYS_PER_RING: u32 = 120;
const LIDAR_RANGE_M: f64 = 50.0;
/// Follow the lane.
const COMMAND: u8 = 4;

const HORIZON: Vector = [206.0, 214.0, 222.0];
const ZENITH: Vector = [92.0, 138.0, 198.0];

/// What the sensors of one moment give.
#[derive(Clone, Debug)]
pub struct Recording {
    speed: f64,
    goal: [f64; 2],
    rgb: Vec<u8>,
    /// `[left, forward, up, intensity]`, relative to the sensor.
    points: Vec<[f32; 4]>,
}

impl Recording {
    /// Camera and LiDAR in a scene.
    pub fn of(scene: &Scene) -> Self {
        let mut noise = scene.noise.clone();
        let rgb = camera(scene, &mut noise);
        Self { speed: scene.speed, goal: scene.goal, rgb, points: lidar(scene, &mut noise) }
    }

    /// As a network of this size reads it.
    pub fn frame(&self, name: String) -> Frame {
        let trained = |p: &[f32; 4]| LidarAxes::Carla.to_trained_frame([p[0], p[1], p[2]], SENSOR_HEIGHT_M);
        let (bev, dropped_points) = bev::histogram(self.points.iter().map(trained), -2.0, Shape::map(SIDE, SIDE, 2));
        Frame {
            name,
            rgb: Some(ByteMap { shape: Shape::map(SIDE, SIDE, 3), data: self.rgb.clone() }),
            bev: Some(bev),
            velocity: Some(self.speed),
            speed: Some(self.speed),
            goal: Some([self.goal[0], 0.0 - self.goal[1]]),
            command: Some(COMMAND),
            dropped_points,
            ..Frame::default()
        }
    }

    /// Writes `rgb.png`, `lidar.bin` and `frame.json`.
    ///
    /// # Errors
    /// A file cannot be written.
    pub fn write(&self, folder: &Path) -> Result<(), Box<dyn std::error::Error>> {
        let side = u32::from(SIDE);
        image::save_buffer(folder.join("rgb.png"), &self.rgb, side, side, image::ColorType::Rgb8)?;
        let points: Vec<u8> = self.points.iter().flatten().flat_map(|v| v.to_le_bytes()).collect();
        fs::write(folder.join("lidar.bin"), points)?;
        let description = json!({
            "speed": self.speed,
            "goal": self.goal,
            "command": COMMAND,
            "lidar_axes": "carla",
            "lidar_height_m": SENSOR_HEIGHT_M,
        });
        fs::write(folder.join("frame.json"), format!("{description:#}\n"))?;
        Ok(())
    }
}

fn camera(scene: &Scene, noise: &mut Random) -> Vec<u8> {
    let middle = 0.5 * (f64::from(SIDE) - 1.0);
    let mut rgb = Vec::new();
    for (row, column) in (0..SIDE).flat_map(|row| (0..SIDE).map(move |column| (row, column))) {
        let direction = [(f64::from(column) - middle) / FOCAL, 1.0, (middle - f64::from(row)) / FOCAL];
        let color = match scene.hit(CAMERA, direction) {
            Some(hit) => blend(hit.color, HORIZON, hit.distance / (hit.distance + 150.0)),
            None => blend(HORIZON, ZENITH, direction[2].abs() / 0.8),
        };
        rgb.extend(color.map(|c| (c * scene.light + noise.range(-3.0, 3.0)).round() as u8));
    }
    rgb
}

fn lidar(scene: &Scene, noise: &mut Random) -> Vec<[f32; 4]> {
    let mut points = Vec::new();
    for (ring, ray) in (0..RINGS).flat_map(|ring| (0..RAYS_PER_RING).map(move |ray| (ring, ray))) {
        // Half a diamond instead of half a circle: nearly even directions without trigonometry.
        let right = (2.0 * f64::from(ray) + 1.0 + noise.range(-0.3, 0.3)) / f64::from(RAYS_PER_RING) - 1.0;
        let forward = 1.0 - right.abs();
        let length = (right * right + forward * forward).sqrt();
        let slope = -0.45 + 0.5 * f64::from(ring) / f64::from(RINGS);
        let direction = [right / length, forward / length, slope];
        let Some(hit) = scene.hit(LIDAR, direction).filter(|hit| hit.distance < LIDAR_RANGE_M) else { continue };
        if noise.range(0.0, 1.0) < 0.05 {
            continue;
        }
        let range = hit.distance + noise.range(-0.02, 0.02);
        let [right, forward, up] = direction.map(|d| (range * d) as f32);
        let brightness = hit.color.iter().sum::<f64>() / 765.0;
        points.push([0.0 - right, forward, up, brightness.min(1.0) as f32]);
    }
    points
}

fn blend(a: Vector, b: Vector, share: f64) -> Vector {
    let share = share.min(1.0);
    [0, 1, 2].map(|i| a[i] + share * (b[i] - a[i]))
}
