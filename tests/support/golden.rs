//! Golden vectors of the published systems: checkpoints, frames, and what the original f32 networks gave for them.
//!
//! Weights are a pure function of tensor name and index (splitmix64), so they are generated instead of stored; only
//! batch-norm statistics are stored, since made-up ones would ruin a deep network. Provenance:
//! `tests/golden/README.md`.

use model_compiler::import::{NamedTensor, NamedTensors, System, TensorData};
use model_compiler::ir::{Graph, ValueId};
use safetensors::tensor::{Dtype, SafeTensors, TensorView};
use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

pub mod lbc;
pub mod network;

pub use lbc::Lbc;
pub use network::Network;

/// Salt of the generated weights that the stored vectors belong to.
const SALT: u64 = 1;

/// Side of the stored frames, pixels.
const FRAME_SIZE: usize = 256;

/// Pixels per cell, and numbers in the list of a cell.
const CELL: usize = 32;
const LIST: usize = 10;

/// Height and width of the stored views of LBC, pixels.
pub const VIEWS: [usize; 2] = [144, 256];

/// A file of `tests/golden`.
pub fn path(file: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/golden").join(file)
}

/// Names and shapes of a system's checkpoint, sorted by name.
///
/// # Panics
/// The system has no stored vectors.
pub fn shapes(system: System) -> Vec<(String, Vec<usize>)> {
    let text = std::fs::read_to_string(path("systems.json")).expect("systems.json");
    let mut systems: BTreeMap<String, BTreeMap<String, Vec<usize>>> = serde_json::from_str(&text).expect("JSON");
    let shapes = systems.remove(system.name()).unwrap_or_else(|| panic!("no golden vectors of {}", system.name()));
    shapes.into_iter().collect()
}

/// The full checkpoint that the stored vectors belong to.
pub fn checkpoint(system: System) -> NamedTensors {
    let mut tensors = generate(&shapes(system));
    let file = Stored::read(&format!("{}.safetensors", system.name()));
    for (name, values) in file.floats("stat.") {
        if let Some(NamedTensor { data: TensorData::Float(data), .. }) = tensors.get_mut(&name) {
            *data = values;
        }
    }
    tensors
}

/// Generated tensors of these names and shapes; `num_batches_tracked` are integers.
pub fn generate(shapes: &[(String, Vec<usize>)]) -> NamedTensors {
    let norms: BTreeSet<&str> = shapes.iter().filter_map(|(name, _)| name.strip_suffix("running_mean")).collect();
    let (counters, floats): (Vec<_>, Vec<_>) =
        shapes.iter().cloned().partition(|(name, _)| name.ends_with("num_batches_tracked"));
    let fill = |(name, shape): (String, Vec<usize>)| {
        let values = values(&name, &shape, &norms);
        (name, shape, values)
    };
    NamedTensors::new(floats.into_iter().map(fill), counters)
}

/// `norms` holds the names of all batch norms, with their final dot.
fn values(name: &str, shape: &[usize], norms: &BTreeSet<&str>) -> Vec<f32> {
    let count: usize = shape.iter().product();
    let (module, leaf) = name.rsplit_once('.').unwrap_or(("", name));
    let parent = module.rsplit('.').next().unwrap_or("");
    let is_norm = norms.contains(&name[..name.len() - leaf.len()]) || ["ln1", "ln2", "ln_f"].contains(&parent);
    let (base, amplitude) = match leaf {
        "running_mean" => (0.0, 0.1),
        "running_var" => (1.0, 0.5),
        "weight" if is_norm => (if parent == "bn2" { 0.5 } else { 1.0 }, 0.25),
        "bias" if is_norm => (0.0, 0.2),
        "pos_emb" => (0.0, 0.5),
        _ if parent == "vel_emb" => (0.0, 0.1),
        _ if name.starts_with("decoder.") => (0.0, 0.25),
        "bias" => (0.0, 0.1),
        _ => {
            let fan_in: usize = if shape.len() > 1 { shape[1..].iter().product() } else { count };
            let gain = match shape.len() {
                _ if name.starts_with("output.") => 12.0,
                _ if name.starts_with("join.") => 6.0,
                4 => 6.0,
                _ => 3.0,
            };
            (0.0, (gain / fan_in as f64).sqrt() as f32)
        }
    };
    uniform(name, count).map(|u| if base == 0.0 { u * amplitude } else { base + u * amplitude }).collect()
}

/// Values in [−1, 1), multiples of 2⁻²³.
fn uniform(name: &str, count: usize) -> impl Iterator<Item = f32> {
    let seed = splitmix64(u64::from(crc32(0, name.as_bytes())) + (SALT << 32));
    (0..count as u64).map(move |i| {
        let bits = splitmix64(seed.wrapping_add(i)) >> 40;
        bits as f32 / (1u32 << 23) as f32 - 1.0
    })
}

pub(crate) fn splitmix64(x: u64) -> u64 {
    let z = x.wrapping_add(0x9E37_79B9_7F4A_7C15);
    let z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
    let z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
    z ^ (z >> 31)
}

/// CRC-32 of zip and zlib, continued from `crc` (0 at first).
fn crc32(crc: u32, bytes: &[u8]) -> u32 {
    const TABLE: [u32; 256] = {
        let mut table = [0; 256];
        let mut i = 0;
        while i < 256 {
            let (mut c, mut bit) = (i as u32, 0);
            while bit < 8 {
                c = if c & 1 == 1 { c >> 1 ^ 0xEDB8_8320 } else { c >> 1 };
                bit += 1;
            }
            table[i] = c;
            i += 1;
        }
        table
    };
    !bytes.iter().fold(!crc, |c, &b| TABLE[(c as u8 ^ b) as usize] ^ c >> 8)
}

/// One stored input of the networks.
#[derive(Clone, Debug)]
pub struct Frame {
    /// `H×W×3`, values 0..=255.
    pub rgb: Vec<f32>,
    /// `H×W×2` counts 0..=5.
    pub bev: Vec<f32>,
    /// m/s.
    pub velocity: f32,
    /// Goal point `[right, forward-negative]`, m.
    pub target: [f32; 2],
    /// Navigation command 1..=6.
    pub command: i32,
    /// Image cells of each LiDAR cell: `H×W×5` pairs.
    pub bev_points: Vec<f32>,
    /// LiDAR cells of each image cell: `H×W×5` pairs.
    pub camera_points: Vec<f32>,
    /// Views and heatmap of LBC, [`VIEWS`]`×10` grey levels.
    pub views: Vec<f32>,
}

impl Frame {
    /// The frame's first rows and columns of the lower center, for a network of smaller input size; of the lists of
    /// cells the first, with numbers that the smaller map has.
    ///
    /// # Panics
    /// The size exceeds the stored one.
    pub fn cropped(&self, height: usize, width: usize) -> Self {
        let (top, left) = (FRAME_SIZE - height, (FRAME_SIZE - width) / 2);
        let crop = |map: &[f32], channels: usize| {
            let row = |y: usize| {
                let start = ((top + y) * FRAME_SIZE + left) * channels;
                map[start..start + width * channels].to_vec()
            };
            (0..height).flat_map(row).collect()
        };
        let cells = [height / CELL, width / CELL];
        let lists = |lists: &[f32]| {
            let row = |y: usize| &lists[y * FRAME_SIZE / CELL * LIST..][..cells[1] * LIST];
            let rows = (0..cells[0]).flat_map(row);
            rows.enumerate().map(|(i, &cell)| cell % cells[i % 2] as f32).collect()
        };
        Self {
            rgb: crop(&self.rgb, 3),
            bev: crop(&self.bev, 2),
            bev_points: lists(&self.bev_points),
            camera_points: lists(&self.camera_points),
            ..self.clone()
        }
    }

    /// The first rows and columns around the middle of the views.
    ///
    /// # Panics
    /// The size exceeds the stored one.
    pub fn cropped_views(&self, height: usize, width: usize) -> Vec<f32> {
        let (top, left) = ((VIEWS[0] - height) / 2, (VIEWS[1] - width) / 2);
        let row = |y: usize| &self.views[((top + y) * VIEWS[1] + left) * 10..][..width * 10];
        (0..height).flat_map(row).copied().collect()
    }
}

/// The stored frames.
pub fn frames() -> Vec<Frame> {
    let file = Stored::read("inputs.safetensors");
    let (rgb, bev) = (file.bytes("rgb"), file.bytes("bev"));
    let (velocity, target) = (file.float("velocity"), file.float("target"));
    let command = file.bytes("command");
    let (bev_points, camera_points) = (file.bytes("bev_points"), file.bytes("cam_points"));
    let lists = |all: &[u8], i: usize| {
        let words = all.as_chunks::<4>().0.iter().map(|bytes| i32::from_le_bytes(*bytes) as f32);
        let count = (FRAME_SIZE / CELL).pow(2) * LIST;
        words.skip(i * count).take(count).collect()
    };
    let views = file.bytes("lbc_views");
    let frame = |i: usize| Frame {
        rgb: channels_last(&rgb, i, 3),
        bev: channels_last(&bev, i, 2),
        velocity: velocity[i],
        target: [target[2 * i], target[2 * i + 1]],
        command: i32::from_le_bytes(command[4 * i..][..4].try_into().expect("four bytes")),
        bev_points: lists(&bev_points, i),
        camera_points: lists(&camera_points, i),
        views: lbc::views(&views, i),
    };
    (0..velocity.len()).map(frame).collect()
}

/// Map `i` of `[N][C][H][W]` bytes as `[H][W][C]`.
fn channels_last(maps: &[u8], i: usize, channels: usize) -> Vec<f32> {
    let positions = FRAME_SIZE * FRAME_SIZE;
    let map = &maps[i * channels * positions..][..channels * positions];
    (0..positions).flat_map(|p| (0..channels).map(move |c| f32::from(map[c * positions + p]))).collect()
}

/// What the original network gave for the stored frames.
#[derive(Clone, Debug)]
pub struct Expected {
    /// Result to its values per frame: `waypoints` are `[right, forward-negative]`, m; of CILRS `steer`, `throttle`,
    /// `brake` and `velocity`; of LBC `points`, `[x, y]` from −1 to 1, and mean and standard deviation over all pixels
    /// of each map of logits, `logits_mean` and `logits_std` (temperature 5, without `hack`).
    pub results: BTreeMap<String, Vec<Vec<f32>>>,
    /// Module name to spatial mean per frame and channel (of a transformer: of its image tokens' part).
    pub taps: BTreeMap<String, Vec<Vec<f32>>>,
}

/// The stored results of a system.
pub fn expected(system: System) -> Expected {
    let file = Stored::read(&format!("{}.safetensors", system.name()));
    let frames =
        |values: &[f32], count: usize| values.chunks_exact(values.len() / count).map(<[f32]>::to_vec).collect();
    let named = |prefix: &str| file.floats(prefix).into_iter().map(|(name, v)| (name, frames(&v, 4))).collect();
    Expected { results: named("expect."), taps: named("tap.") }
}

/// The value of an imported graph (before or after the passes) that a tap of this module is the mean of: a container's
/// result is that of its last member.
pub fn tapped_value(graph: &Graph, module: &str) -> Option<ValueId> {
    let last = (0..64).rev().find_map(|i| graph.find(&format!("{module}.{i}")));
    graph.find(module).or(last).or_else(|| graph.find(&format!("{module}.ln_f.image")))
}

/// Writes a checkpoint as a `.safetensors` file; integers become the scalar 1.
///
/// # Errors
/// The file cannot be written, or a tensor has not as many values as its shape says.
pub fn write_safetensors(tensors: &NamedTensors, path: &Path) -> Result<(), safetensors::SafeTensorError> {
    let bytes: Vec<(Dtype, Vec<u8>)> = tensors.iter().map(|(_, t)| to_bytes(t)).collect();
    let views = tensors.iter().zip(&bytes).map(|((name, tensor), (dtype, bytes))| {
        Ok((name.to_string(), TensorView::new(*dtype, tensor.shape.clone(), bytes)?))
    });
    let views: Vec<_> = views.collect::<Result<_, safetensors::SafeTensorError>>()?;
    safetensors::serialize_to_file(views, None, path)
}

fn to_bytes(tensor: &NamedTensor) -> (Dtype, Vec<u8>) {
    match &tensor.data {
        TensorData::Float(values) => (Dtype::F32, values.iter().flat_map(|v| v.to_le_bytes()).collect()),
        TensorData::Integer => {
            let count = tensor.shape.iter().product();
            (Dtype::I64, std::iter::repeat_n(1i64.to_le_bytes(), count).flatten().collect())
        }
    }
}

/// A stored `.safetensors` file.
struct Stored {
    file: Vec<u8>,
}

impl Stored {
    fn read(name: &str) -> Self {
        Self { file: std::fs::read(path(name)).unwrap_or_else(|e| panic!("{name}: {e}")) }
    }

    fn tensors(&self) -> SafeTensors<'_> {
        SafeTensors::deserialize(&self.file).expect("safetensors")
    }

    fn bytes(&self, name: &str) -> Vec<u8> {
        self.tensors().tensor(name).unwrap_or_else(|e| panic!("{name}: {e}")).data().to_vec()
    }

    fn float(&self, name: &str) -> Vec<f32> {
        to_floats(&self.bytes(name))
    }

    /// The float tensors whose names start with `prefix`, without it.
    fn floats(&self, prefix: &str) -> Vec<(String, Vec<f32>)> {
        let tensors = self.tensors();
        let named = tensors.iter().filter(|(_, view)| view.dtype() == Dtype::F32);
        named
            .filter_map(|(name, view)| Some((name.strip_prefix(prefix)?.to_string(), to_floats(view.data()))))
            .collect()
    }
}

fn to_floats(bytes: &[u8]) -> Vec<f32> {
    bytes.chunks_exact(4).map(|b| f32::from_le_bytes(b.try_into().expect("four bytes"))).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// CRC-32 over the bytes of all float tensors, in the order of their names.
    fn crc(tensors: &NamedTensors) -> u32 {
        tensors.iter().fold(0, |crc, (_, tensor)| match &tensor.data {
            TensorData::Float(_) => crc32(crc, &to_bytes(tensor).1),
            TensorData::Integer => crc,
        })
    }

    #[test]
    fn checkpoints_equal_those_of_the_python_generator() {
        for (system, expected) in [
            (System::Aim, 0x2608_0f08),
            (System::LateFusion, 0xcd82_6882),
            (System::TransFuser, 0x9953_4b15),
            (System::GeometricFusion, 0xd579_3ed8),
            (System::Cilrs, 0xfdc5_b069),
            (System::Lbc, 0x0497_a3a4),
        ] {
            assert_eq!(crc(&checkpoint(system)), expected, "{}", system.name());
        }
    }

    #[test]
    fn every_rule_gives_the_values_of_the_python_generator() {
        // First, second and last value of each, as bits.
        let tensors = checkpoint(System::TransFuser);
        for (name, expected) in [
            ("encoder.image_encoder.features.conv1.weight", [0xbe3b4db0, 0x3e41cf61, 0xbd4424ca]),
            ("encoder.image_encoder.features.layer2.0.bn2.weight", [0x3f3e767a, 0x3f39cf1a, 0x3ee4ab49]),
            ("encoder.image_encoder.features.layer2.0.downsample.1.bias", [0xbc3cf267, 0xbdf813d3, 0x3c40da1a]),
            ("encoder.lidar_encoder._model.bn1.running_var", [0x3ca33e69, 0x3c7fcbaf, 0x3c83277f]),
            ("encoder.transformer1.pos_emb", [0xbeee59a2, 0x3efa2a3e, 0xbecc906e]),
            ("encoder.transformer2.vel_emb.weight", [0xbd5a280d, 0xbda44432, 0xbd9521cd]),
            ("encoder.transformer3.blocks.5.mlp.2.weight", [0xbc95f414, 0xbd23656b, 0x3c6b93e6]),
            ("encoder.transformer4.blocks.7.attn.key.bias", [0x3d5c00da, 0x3d24c36a, 0x3cd5c1d3]),
            ("encoder.transformer4.ln_f.weight", [0x3f71929b, 0x3f798e6c, 0x3f70fbfb]),
            ("join.2.weight", [0x3cab35c1, 0x3c847c18, 0xbdc3fa20]),
            ("decoder.weight_hh", [0x3dba28c4, 0x3dbec7cc, 0x3df64b38]),
            ("output.weight", [0xbeb3b324, 0xbec2ece6, 0x3e68a36e]),
        ] {
            let Some(TensorData::Float(v)) = tensors.get(name).map(|t| &t.data) else { panic!("{name}") };
            assert_eq!([v[0], v[1], v[v.len() - 1]].map(f32::to_bits), expected, "{name}");
        }
    }

    #[test]
    fn stored_frames_are_complete() {
        let frames = frames();
        assert_eq!(frames.len(), 4);
        assert_eq!(frames.iter().map(|f| f.velocity).collect::<Vec<_>>(), [0.0, 2.5, 5.25, 7.0]);
        assert_eq!(frames[2].target, [3.25, -45.0]);
        for frame in &frames {
            assert_eq!((frame.rgb.len(), frame.bev.len()), (256 * 256 * 3, 256 * 256 * 2));
            assert_eq!(frame.views.len(), 144 * 256 * 10);
            assert_eq!(frame.cropped_views(32, 64)[..10], frame.views[(56 * 256 + 96) * 10..][..10]);
            assert!(frame.rgb.iter().all(|v| (0.0..=255.0).contains(v)) && frame.rgb.iter().any(|&v| v > 100.0));
            assert!(frame.bev.iter().all(|v| (0.0..=5.0).contains(v)) && frame.bev.iter().any(|&v| v > 0.0));
            assert!((1..=6).contains(&frame.command));
            for lists in [&frame.bev_points, &frame.camera_points] {
                assert_eq!(lists.len(), 8 * 8 * 10);
                assert!(lists.iter().all(|v| (0.0..=7.0).contains(v)) && lists.contains(&7.0));
            }
            let small = frame.cropped(64, 32);
            assert_eq!((small.rgb.len(), small.bev.len()), (64 * 32 * 3, 64 * 32 * 2));
            assert_eq!(small.bev_points.len(), 2 * 10);
            assert!(small.bev_points.chunks(2).all(|pair| pair[0] <= 1.0 && pair[1] == 0.0));
            assert_eq!(small.rgb[..3], frame.rgb[(192 * 256 + 112) * 3..][..3]);
        }
    }

    #[test]
    fn stored_results_are_complete() {
        for (system, taps, values) in [
            (System::Aim, 5, 8),
            (System::LateFusion, 9, 8),
            (System::TransFuser, 13, 8),
            (System::GeometricFusion, 9, 8),
            (System::Cilrs, 4, 4),
            (System::Lbc, 0, 16),
        ] {
            let expected = expected(system);
            assert!(expected.results.values().all(|frames| frames.len() == 4));
            let of_first: usize = expected.results.values().map(|frames| frames[0].len()).sum();
            assert_eq!((of_first, expected.taps.len()), (values, taps));
            assert!(expected.taps.values().all(|t| t.len() == 4 && t[0].len() >= 64));
        }
    }

    #[test]
    fn written_checkpoint_reads_back() {
        let tensors = Network::small(System::Aim).tensors();
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("aim.safetensors");
        write_safetensors(&tensors, &file).unwrap();
        let stored = Stored { file: std::fs::read(file).unwrap() };
        let floats = stored.floats("");
        assert!(floats.iter().all(|(name, values)| {
            matches!(tensors.get(name), Some(NamedTensor { data: TensorData::Float(v), .. }) if v == values)
        }));
        assert_eq!(stored.tensors().len(), tensors.len());
    }
}
