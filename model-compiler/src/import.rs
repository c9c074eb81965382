//! From a file to the float graph: a checkpoint's tensors, or an ONNX model ([`onnx`]).
//!
//! The readers ([`checkpoint`]) give [`NamedTensors`]; the system is told from the names; every size of the network
//! (channels, blocks, fusion scales, transformer layers, hidden sizes) from the shapes; the graph that comes out stays
//! close to the framework's modules and carries their names. A checkpoint that does not fit is refused with one list
//! of all its tensors that are missing, surplus, misshapen or not finite.

use crate::artifact::folder_of;
use crate::error::{Error, ErrorCode, Result};
use crate::ir::{Graph, Normalization};
use std::collections::BTreeMap;
use std::ops::Bound;
use std::path::Path;
use std::str::FromStr;

pub mod checkpoint;
pub mod onnx;
mod systems;

/// Elements of a checkpoint tensor.
#[derive(Clone, Debug, PartialEq)]
pub enum TensorData {
    /// Row-major values.
    Float(Vec<f32>),
    /// An integer tensor: no network here has one that matters (`num_batches_tracked` counts training steps).
    Integer,
}

/// A tensor of a checkpoint.
#[derive(Clone, Debug, PartialEq)]
pub struct NamedTensor {
    /// Dimensions, outermost first; empty for a scalar.
    pub shape: Vec<usize>,
    /// Elements, as many as the shape says.
    pub data: TensorData,
}

/// The tensors of a checkpoint by name, in the order of their names.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct NamedTensors {
    tensors: BTreeMap<String, NamedTensor>,
}

impl NamedTensors {
    /// The given float tensors (name, shape, row-major values) and integer tensors (name, shape).
    pub fn new(
        floats: impl IntoIterator<Item = (String, Vec<usize>, Vec<f32>)>,
        integers: impl IntoIterator<Item = (String, Vec<usize>)>,
    ) -> Self {
        let floats = floats.into_iter().map(|(n, shape, v)| (n, NamedTensor { shape, data: TensorData::Float(v) }));
        let integers = integers.into_iter().map(|(n, shape)| (n, NamedTensor { shape, data: TensorData::Integer }));
        Self { tensors: floats.chain(integers).collect() }
    }

    /// Adds or replaces a tensor.
    pub fn insert(&mut self, name: impl Into<String>, tensor: NamedTensor) {
        self.tensors.insert(name.into(), tensor);
    }

    /// Takes a tensor out.
    pub fn remove(&mut self, name: &str) -> Option<NamedTensor> {
        self.tensors.remove(name)
    }

    /// The tensor of this name.
    pub fn get(&self, name: &str) -> Option<&NamedTensor> {
        self.tensors.get(name)
    }

    /// The tensor of this name, to change it.
    pub fn get_mut(&mut self, name: &str) -> Option<&mut NamedTensor> {
        self.tensors.get_mut(name)
    }

    /// All tensors, in the order of their names.
    pub fn iter(&self) -> impl Iterator<Item = (&str, &NamedTensor)> + '_ {
        self.tensors.iter().map(|(name, tensor)| (name.as_str(), tensor))
    }

    /// The tensors whose names start with `prefix`.
    pub fn under<'a>(&'a self, prefix: &'a str) -> impl Iterator<Item = (&'a str, &'a NamedTensor)> + 'a {
        self.tensors
            .range::<str, _>((Bound::Included(prefix), Bound::Unbounded))
            .take_while(move |(name, _)| name.starts_with(prefix))
            .map(|(name, tensor)| (name.as_str(), tensor))
    }

    /// Number of tensors.
    pub fn len(&self) -> usize {
        self.tensors.len()
    }

    /// Whether there is no tensor.
    pub fn is_empty(&self) -> bool {
        self.tensors.is_empty()
    }
}

impl From<checkpoint::Checkpoint> for NamedTensors {
    fn from(checkpoint: checkpoint::Checkpoint) -> Self {
        let tensors = checkpoint.into_tensors().into_iter().map(|tensor| {
            let data = match tensor.data {
                checkpoint::TensorData::Float(values) => TensorData::Float(values),
                checkpoint::TensorData::Integer(_) => TensorData::Integer,
            };
            (tensor.name, NamedTensor { shape: tensor.shape, data })
        });
        Self { tensors: tensors.collect() }
    }
}

/// A driving network that is told from its tensor names.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum System {
    /// Image only (ResNet-34), waypoints.
    Aim,
    /// Image and LiDAR, added at the end, waypoints.
    LateFusion,
    /// Image and LiDAR, fused by transformers at up to four scales, waypoints.
    TransFuser,
    /// Image and LiDAR, fused by sums over cells that see the same points at up to four scales, waypoints.
    GeometricFusion,
    /// Image (ResNet-18), speed and command, controls.
    Cilrs,
    /// Learning by cheating: three views and a heatmap of the target (DeepLabV3 on ResNet-50), points in the image.
    Lbc,
}

impl System {
    /// Every system.
    pub const ALL: [Self; 6] =
        [Self::Aim, Self::LateFusion, Self::TransFuser, Self::GeometricFusion, Self::Cilrs, Self::Lbc];

    /// Name on the command line and in reports.
    pub fn name(self) -> &'static str {
        match self {
            Self::Aim => "aim",
            Self::LateFusion => "late_fusion",
            Self::TransFuser => "transfuser",
            Self::GeometricFusion => "geometric_fusion",
            Self::Cilrs => "cilrs",
            Self::Lbc => "lbc",
        }
    }

    /// The names of all systems, in a row.
    fn names() -> String {
        Self::ALL.map(Self::name).join(", ")
    }

    /// The system whose tensor names these are.
    pub fn detect(tensors: &NamedTensors) -> Option<Self> {
        systems::detect(tensors)
    }
}

impl FromStr for System {
    type Err = Error;

    fn from_str(name: &str) -> Result<Self> {
        Self::ALL.into_iter().find(|s| s.name() == name).ok_or_else(|| {
            Error::new(ErrorCode::Usage, "", format!("unknown system '{name}'"))
                .with_help(format!("one of {}", Self::names()))
        })
    }
}

/// What cannot be told from the file.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct ImportOptions {
    /// Checkpoints: the system; detected from the tensor names when absent.
    pub system: Option<System>,
    /// Checkpoints: attention heads of the transformers; 4 when absent.
    pub heads: Option<u16>,
    /// Geometric Fusion: how many of the last stages are fused, 1..=4; all when absent. No tensor tells.
    pub fusion_scales: Option<u8>,
    /// Height and width of image, views and BEV inputs, pixels. When absent: 32 pixels per token where a square
    /// positional embedding tells the token grid, else as published: 256×256, of LBC 144×256; for ONNX what the file
    /// says.
    pub resolution: Option<(u16, u16)>,
    /// ONNX: mean and deviation of the image in grey levels 0..=255, one value for all channels or one for each. When
    /// absent: ImageNet's for three channels, 0 and 255 (so 0..1) for one.
    pub normalization: Option<Normalization>,
    /// LBC: halve the views before the network and double its maps behind it.
    pub hack: bool,
    /// LBC: what divides the logits before the spatial softmax, positive; 5 when absent.
    pub temperature: Option<f32>,
}

/// Builds the float graph of a file, a checkpoint or an ONNX model, told by its content.
///
/// # Errors
/// `Io` where the file cannot be read, those of its reader, of [`import`] and of [`onnx::import`], all naming the file;
/// `Usage` for an option that belongs to the other kind of file.
pub fn read(path: &Path, options: &ImportOptions) -> Result<Graph> {
    let name = path.display().to_string();
    let bytes = checkpoint::read_bounded(path)?;
    if onnx::is_onnx(&bytes) {
        let model = onnx::Model::parse(bytes).map_err(|e| e.within(&name))?;
        return onnx::import(&model, Some(folder_of(path)), options).map_err(|e| e.within(&name));
    }
    if options.normalization.is_some() {
        return Err(Error::new(ErrorCode::Usage, name, "--mean, --std and --scale have no effect on a checkpoint")
            .with_help("leave them out; the normalization belongs to the system"));
    }
    let tensors = checkpoint::parse(&bytes).map_err(|e| e.within(&name))?.into();
    import(&name, tensors, options)
}

/// Builds the float graph of a checkpoint; `name` (the file) names the model and leads error messages.
///
/// Inputs are `rgb`, `bev`, `velocity`, `command`, `bev_points`, `cam_points`, `goal` and `views`, as far as the system
/// has them, in raw units; the output is `waypoints`, of CILRS `controls` (the sigmoids of steer, throttle and brake)
/// and `predicted_speed` (m/s), of LBC `points` (pixels). Values carry the names of the checkpoint's modules.
///
/// # Errors
/// `Unsupported`: no known system, or sizes that do not fit together. `Tensors`: the list of tensors that are missing,
/// surplus, misshapen or not finite. `Usage`: an option that belongs to another system.
pub fn import(name: &str, tensors: NamedTensors, options: &ImportOptions) -> Result<Graph> {
    let system =
        options.system.or_else(|| System::detect(&tensors)).ok_or_else(|| unrecognized(&tensors).within(name))?;
    systems::build(system, name, tensors, options).map_err(|e| e.within(name))
}

fn unrecognized(tensors: &NamedTensors) -> Error {
    let first: Vec<_> = tensors.iter().take(3).map(|(name, _)| name).collect();
    let message = if first.is_empty() {
        "the checkpoint holds no tensors".to_string()
    } else {
        format!("the tensor names are of no known system ({} tensors: {}, …)", tensors.len(), first.join(", "))
    };
    Error::new(ErrorCode::Unsupported, "", message).with_help(format!(
        "supported are checkpoints of {} (versions up to 2021); --system names one",
        System::names()
    ))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn names(names: &[&str]) -> NamedTensors {
        NamedTensors::new(names.iter().map(|n| (n.to_string(), vec![1], vec![0.0])), [])
    }

    #[test]
    fn every_system_is_told_from_its_names() {
        let image = "image_encoder.features.conv1.weight";
        for (system, tensors) in [
            (System::Aim, names(&[image])),
            (System::LateFusion, names(&[image, "lidar_encoder._model.conv1.weight"])),
            (
                System::TransFuser,
                names(&["encoder.image_encoder.features.conv1.weight", "encoder.transformer4.pos_emb"]),
            ),
            (
                System::TransFuser,
                names(&["encoder.transformer.ln_f.weight", "encoder.image_conv1.weight", "encoder.lidar_conv1.weight"]),
            ),
            (
                System::GeometricFusion,
                names(&["encoder.image_encoder.features.conv1.weight", "encoder.image_conv1.weight"]),
            ),
            (System::Cilrs, names(&["encoder.features.conv1.weight", "controller.vel_in.0.weight"])),
            (System::Lbc, names(&["net.network.backbone.conv1.weight"])),
            (System::Lbc, names(&["model.net.network.backbone.conv1.weight", "model.teacher.net.norm.bias"])),
        ] {
            assert_eq!(System::detect(&tensors), Some(system));
            assert_eq!(system.name().parse::<System>().unwrap(), system);
        }
        assert_eq!(System::detect(&names(&["fc.weight"])), None);
    }

    #[test]
    fn foreign_checkpoint_is_refused_with_its_first_names() {
        let error = import("m.pth", names(&["fc.bias", "fc.weight"]), &ImportOptions::default()).unwrap_err();
        assert_eq!(
            error.to_string(),
            "m.pth: the tensor names are of no known system (2 tensors: fc.bias, fc.weight, …)\n  \
             help: supported are checkpoints of aim, late_fusion, transfuser, geometric_fusion, cilrs, lbc \
             (versions up to 2021); --system names one"
        );
    }

    #[test]
    fn prefix_selects_a_contiguous_range() {
        let tensors = names(&["a", "ab.c", "ab.d", "abc", "b"]);
        assert_eq!(tensors.under("ab.").map(|(n, _)| n).collect::<Vec<_>>(), ["ab.c", "ab.d"]);
    }
}
