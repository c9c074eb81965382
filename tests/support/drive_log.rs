//! A small recorded sequence: a vehicle on a winding road, seen by procedural sensors. A pure function of its seed.

use crate::commands::Folder;
use crate::random::Random;
use serde_json::{Value, json};

/// More nodes than a driver holds.
const NODES: u32 = 200;

/// What is written to a log's folder.
#[derive(Clone, Debug)]
pub struct Recording {
    /// Columns and rows of the cameras' images.
    pub image: (u32, u32),
    /// Files of the cameras.
    pub cameras: &'static [&'static str],
    /// Steps.
    pub steps: usize,
    /// Of everything random.
    pub seed: u64,
}

impl Recording {
    /// Writes `NAME/route.json` and `NAME/frames/…`; `change` may change the description of a step.
    ///
    /// # Panics
    /// A file cannot be written.
    pub fn write(&self, folder: &Folder, name: &str, change: impl Fn(usize, &mut Value)) {
        let mut random = Random::new(self.seed);
        // A node every four meters of a road that bends with its length.
        let road = |meters: f64| [meters, 0.002 * meters * meters];
        let nodes: Vec<[f64; 2]> = (0..NODES).map(|k| road(4.0 * f64::from(k))).collect();
        let commands: Vec<u8> = (0..NODES).map(|k| [4, 4, 3, 1, 2][k as usize % 5]).collect();
        folder.write(&format!("{name}/route.json"), json!({"nodes": nodes, "commands": commands}).to_string());
        for step in 0..self.steps {
            let travel = 0.2 * step as f64;
            let mut description = json!({
                "speed": 4.0 + 0.1 * f64::from(random.signed_unit()),
                "position": road(travel),
                "compass": (0.004 * travel).atan(),
            });
            change(step, &mut description);
            let frame = format!("{name}/frames/{step:04}");
            folder.write(&format!("{frame}/frame.json"), description.to_string());
            let mut points = Vec::new();
            for _ in 0..500 {
                let [left, forward, up] = [30.0, 16.0, 2.0].map(|range| range * random.signed_unit());
                points.extend([left, forward + 16.0, up - 1.0, 0.5].iter().flat_map(|v| v.to_le_bytes()));
            }
            folder.write(&format!("{frame}/lidar.bin"), points);
            let (width, height) = self.image;
            for camera in self.cameras {
                let shade = random.below(64) as u32;
                let pixel = |x: u32, y: u32| image::Rgb([(x * 5 + shade) as u8, (y * 3) as u8, (x ^ y) as u8]);
                let picture = image::RgbImage::from_fn(width, height, pixel);
                picture.save(folder.path(&format!("{frame}/{camera}"))).expect("a writable folder");
            }
        }
    }
}
