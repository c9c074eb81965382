//! A street from a seed, and what a ray meets in it.
//!
//! Axes are `[right, forward, up]` in meters; the car stands at the origin in the right lane. Only arithmetic that is
//! exact to the last bit on every machine is used: no trigonometry.

use crate::golden::splitmix64;

/// `[right, forward, up]`, m; or red, green, blue, 0..=255.
pub type Vector = [f64; 3];

const LANE_M: f64 = 3.5;
const SIDEWALK_M: f64 = 2.0;
const MARKING_M: f64 = 0.16;

const ASPHALT: Vector = [74.0, 74.0, 80.0];
const PAINT: Vector = [222.0, 222.0, 212.0];
const PAVEMENT: Vector = [138.0, 132.0, 124.0];
const GRASS: Vector = [72.0, 104.0, 48.0];
const GLASS: Vector = [42.0, 48.0, 56.0];

/// A street with cars, buildings and poles.
#[derive(Clone, Debug)]
pub struct Scene {
    /// Forward speed, m/s.
    pub speed: f64,
    /// Goal `[right, forward]`, m: a point of the own lane.
    pub goal: [f64; 2],
    /// Brightness, 1 at noon.
    pub light: f64,
    /// Source of the sensors' noise.
    pub noise: Random,
    /// Curvature of the road, 1/m; positive bends right.
    bend: f64,
    solids: Vec<Solid>,
}

/// A box along the axes.
#[derive(Clone, Debug)]
struct Solid {
    min: Vector,
    max: Vector,
    color: Vector,
}

/// Where a ray ends.
#[derive(Clone, Copy, Debug)]
pub struct Hit {
    /// In units of the ray's direction.
    pub distance: f64,
    /// Color of the surface in daylight.
    pub color: Vector,
}

/// Uniform numbers from a seed.
#[derive(Clone, Debug)]
pub struct Random(u64);

impl Random {
    /// Uniform in `low..high`.
    pub fn range(&mut self, low: f64, high: f64) -> f64 {
        self.0 = splitmix64(self.0);
        low + (high - low) * unit(self.0)
    }

    fn pick<T: Copy>(&mut self, choices: &[T]) -> T {
        choices[self.range(0.0, choices.len() as f64) as usize]
    }
}

/// The upper 53 bits as a number in `0..1`.
fn unit(bits: u64) -> f64 {
    (bits >> 11) as f64 / (1_u64 << 53) as f64
}

impl Scene {
    /// The street of a seed.
    pub fn new(seed: u64) -> Self {
        let mut random = Random(splitmix64(seed));
        let bend = random.range(-0.012, 0.012);
        let goal_m = rounded(random.range(12.0, 32.0));
        let mut scene = Self {
            speed: rounded(random.range(0.0, 8.0)),
            goal: [rounded(0.5 * bend * goal_m * goal_m), goal_m],
            light: random.range(0.55, 1.15),
            noise: random.clone(),
            bend,
            solids: Vec::new(),
        };
        scene.add_cars(&mut random);
        for side in [-1.0, 1.0] {
            scene.add_buildings(&mut random, side);
            scene.add_poles(&mut random, side);
        }
        scene.noise = random;
        scene
    }

    /// Right coordinate of the line between the lanes.
    fn center(&self, forward: f64) -> f64 {
        0.5 * self.bend * forward * forward - 0.5 * LANE_M
    }

    fn add_cars(&mut self, random: &mut Random) {
        for lane in [-0.5, 0.5] {
            let mut forward = random.range(8.0, 22.0);
            while forward < 60.0 {
                let right = self.center(forward) + lane * LANE_M + random.range(-0.3, 0.3);
                let color = random.pick(&[[172.0, 30.0, 34.0], [36.0, 62.0, 148.0], [208.0; 3], [40.0; 3]]);
                self.add([right, forward, 0.25], [1.8, 4.2, 0.65], color);
                self.add([right, forward + 0.8, 0.9], [1.6, 2.2, 0.55], GLASS);
                forward += random.range(9.0, 30.0);
            }
        }
    }

    fn add_buildings(&mut self, random: &mut Random, side: f64) {
        let mut forward = random.range(0.0, 8.0);
        while forward < 90.0 {
            let (depth, height) = (random.range(6.0, 14.0), random.range(3.0, 14.0));
            let width = random.range(5.0, 9.0);
            let right = self.center(forward) + side * (LANE_M + SIDEWALK_M + random.range(1.0, 8.0) + 0.5 * width);
            let color = random.pick(&[[150.0, 108.0, 84.0], [168.0, 160.0, 140.0], [104.0, 112.0, 122.0]]);
            self.add([right, forward, 0.0], [width, depth, height], color);
            forward += depth + random.range(1.0, 10.0);
        }
    }

    fn add_poles(&mut self, random: &mut Random, side: f64) {
        let mut forward = random.range(4.0, 12.0);
        while forward < 60.0 {
            let right = self.center(forward) + side * (LANE_M + 0.6);
            self.add([right, forward, 0.0], [0.25, 0.25, 5.5], [92.0, 90.0, 86.0]);
            forward += random.range(12.0, 18.0);
        }
    }

    /// Adds a box over the middle of its lower front edge.
    fn add(&mut self, [right, forward, up]: Vector, [width, depth, height]: Vector, color: Vector) {
        let min = [right - 0.5 * width, forward, up];
        self.solids.push(Solid { min, max: [min[0] + width, forward + depth, up + height], color });
    }

    /// The nearest surface that a ray meets; `None`: the sky.
    pub fn hit(&self, origin: Vector, direction: Vector) -> Option<Hit> {
        let solids = self.solids.iter().filter_map(|solid| solid.hit(origin, direction));
        solids.chain(self.ground(origin, direction)).min_by(|a, b| a.distance.total_cmp(&b.distance))
    }

    fn ground(&self, origin: Vector, direction: Vector) -> Option<Hit> {
        let distance = -origin[2] / direction[2];
        let [right, forward] = [0, 1].map(|axis| origin[axis] + distance * direction[axis]);
        (direction[2] < 0.0).then(|| Hit { distance, color: self.ground_color(right, forward) })
    }

    fn ground_color(&self, right: f64, forward: f64) -> Vector {
        let lateral = right - self.center(forward);
        let is_dash = lateral.abs() < 0.5 * MARKING_M && forward.rem_euclid(6.0) < 3.0;
        let is_edge = (lateral.abs() - LANE_M + MARKING_M).abs() < 0.5 * MARKING_M;
        let color = match lateral.abs() {
            _ if is_dash || is_edge => PAINT,
            distance if distance < LANE_M => ASPHALT,
            distance if distance < LANE_M + SIDEWALK_M => PAVEMENT,
            _ => GRASS,
        };
        let grain = texture(right, forward);
        color.map(|c| c * (1.0 + 0.18 * grain))
    }
}

impl Solid {
    fn hit(&self, origin: Vector, direction: Vector) -> Option<Hit> {
        let (mut near, mut far, mut face) = (0.0, f64::INFINITY, 0);
        for axis in 0..3 {
            let bounds = [self.min, self.max].map(|corner| (corner[axis] - origin[axis]) / direction[axis]);
            let (enter, leave) = (bounds[0].min(bounds[1]), bounds[0].max(bounds[1]));
            if enter > near {
                (near, face) = (enter, axis);
            }
            far = leave.min(far);
        }
        // Sides, front and top catch different light.
        let shade = [0.72, 0.9, 1.1][face];
        let point = [0, 1, 2].map(|axis| origin[axis] + near * direction[axis]);
        let grain = texture(point[0] + point[1], point[2]);
        let color = self.color.map(|c| c * shade * (1.0 + 0.08 * grain));
        (near > 0.0 && near < far).then_some(Hit { distance: near, color })
    }
}

/// Grain of a surface, −1..1: one value per quarter of a meter.
fn texture(a: f64, b: f64) -> f64 {
    let cell = |v: f64| (v * 4.0).floor() as i64 as u64;
    2.0 * unit(splitmix64(splitmix64(cell(a)) ^ cell(b))) - 1.0
}

/// To hundredths, as written to files.
fn rounded(value: f64) -> f64 {
    (value * 100.0).round() / 100.0
}
