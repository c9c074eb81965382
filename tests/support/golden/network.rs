//! Checkpoints of any size: the tensor names and shapes of a described network, with generated values.

use super::{generate, uniform};
use model_compiler::import::{NamedTensor, NamedTensors, System, TensorData};

/// Sizes of a network; the published ones, small ones for fast tests, or an ablation of either.
#[derive(Clone, Debug)]
pub struct Network {
    /// Which of the published systems.
    pub system: System,
    /// Channels of stem and first stage.
    pub stem: usize,
    /// Channels per stage.
    pub widths: [usize; 4],
    /// Blocks per stage of the image network.
    pub image_blocks: [usize; 4],
    /// Blocks per stage of the LiDAR network.
    pub lidar_blocks: [usize; 4],
    /// Layers of each transformer.
    pub layers: usize,
    /// Token grid, height and width; the input has 32 times the size.
    pub grid: (usize, usize),
    /// Whether there are positional embeddings.
    pub position: bool,
    /// Fusion scales, of 1..=4.
    pub scales: Vec<u8>,
    /// Geometric Fusion: channels of an embedding.
    pub embedding: usize,
    /// Geometric Fusion: outputs of the layers of a projection.
    pub projection: Vec<usize>,
    /// Width of one transformer that all scales share, with 1×1 convolutions to it and back.
    pub shared: Option<usize>,
    /// Outputs of the join layers; the last is the hidden size of the GRU.
    pub join: Vec<usize>,
    /// Input width of the GRU: 2 (added) or 4 (concatenated).
    pub gru_inputs: usize,
    /// Of CILRS: hidden size of its heads.
    pub hidden: usize,
    /// Of CILRS: branches, one per command.
    pub branches: usize,
}

impl Network {
    /// The system as published.
    pub fn published(system: System) -> Self {
        Self {
            system,
            stem: 64,
            widths: [64, 128, 256, 512],
            image_blocks: if system == System::Cilrs { [2; 4] } else { [3, 4, 6, 3] },
            lidar_blocks: [2; 4],
            layers: 8,
            grid: (8, 8),
            position: true,
            scales: vec![1, 2, 3, 4],
            embedding: 512,
            projection: vec![512; 3],
            shared: None,
            join: vec![256, 128, 64],
            gru_inputs: if matches!(system, System::TransFuser | System::GeometricFusion) { 2 } else { 4 },
            hidden: 256,
            branches: 6,
        }
    }

    /// The system with one or two blocks per stage, few channels, and an input of 64×64.
    pub fn small(system: System) -> Self {
        Self {
            stem: 8,
            widths: [8, 16, 24, 32],
            image_blocks: [2, 1, 1, 1],
            lidar_blocks: [1; 4],
            layers: 2,
            grid: (2, 2),
            embedding: 20,
            projection: vec![24, 12, 28],
            join: vec![24, 16],
            hidden: 16,
            ..Self::published(system)
        }
    }

    /// Height and width of the input, pixels.
    pub fn resolution(&self) -> (u16, u16) {
        (32 * self.grid.0 as u16, 32 * self.grid.1 as u16)
    }

    /// Names and shapes of the checkpoint.
    pub fn shapes(&self) -> Vec<(String, Vec<usize>)> {
        let mut list = List::default();
        if self.system == System::Cilrs {
            self.resnet(&mut list, "encoder.features", 3, &self.image_blocks);
            self.controller(&mut list);
            return list.0;
        }
        let root = match self.system {
            System::TransFuser | System::GeometricFusion => "encoder.",
            _ => "",
        };
        self.resnet(&mut list, &format!("{root}image_encoder.features"), 3, &self.image_blocks);
        if self.system != System::Aim {
            self.resnet(&mut list, &format!("{root}lidar_encoder._model"), 2, &self.lidar_blocks);
        }
        if self.system == System::TransFuser {
            match self.shared {
                None => self.scales.iter().for_each(|&scale| {
                    let width = self.widths[usize::from(scale) - 1];
                    self.transformer(&mut list, &format!("encoder.transformer{scale}"), width);
                }),
                Some(width) => {
                    self.transformer(&mut list, "encoder.transformer", width);
                    self.scales.iter().for_each(|&scale| self.projections(&mut list, scale, width));
                }
            }
        }
        if self.system == System::GeometricFusion {
            for side in ["image", "lidar"] {
                (1..=4).for_each(|scale| self.geometric_fusion(&mut list, side, scale));
            }
        }
        self.head(&mut list);
        list.0
    }

    /// Generated values with plausible batch-norm statistics: activations stay of order 1 on real frames.
    pub fn tensors(&self) -> NamedTensors {
        plausible(&self.shapes(), typical_variance)
    }

    /// All values zero: enough where only names and shapes matter.
    pub fn zeros(&self) -> NamedTensors {
        let (counters, floats): (Vec<_>, Vec<_>) =
            self.shapes().into_iter().partition(|(name, _)| name.ends_with("num_batches_tracked"));
        let fill = |(name, shape): (String, Vec<usize>)| {
            let values = vec![0.0; shape.iter().product()];
            (name, shape, values)
        };
        NamedTensors::new(floats.into_iter().map(fill), counters)
    }

    fn resnet(&self, list: &mut List, prefix: &str, channels: usize, blocks: &[usize; 4]) {
        list.add(format!("{prefix}.conv1.weight"), &[self.stem, channels, 7, 7]);
        list.batch_norm(&format!("{prefix}.bn1"), self.stem);
        let mut input = self.stem;
        for (stage, (&width, &count)) in self.widths.iter().zip(blocks).enumerate() {
            for block in 0..count {
                let module = format!("{prefix}.layer{}.{block}", stage + 1);
                list.add(format!("{module}.conv1.weight"), &[width, input, 3, 3]);
                list.batch_norm(&format!("{module}.bn1"), width);
                list.add(format!("{module}.conv2.weight"), &[width, width, 3, 3]);
                list.batch_norm(&format!("{module}.bn2"), width);
                if block == 0 && (stage > 0 || input != width) {
                    list.add(format!("{module}.downsample.0.weight"), &[width, input, 1, 1]);
                    list.batch_norm(&format!("{module}.downsample.1"), width);
                }
                input = width;
            }
        }
    }

    fn projections(&self, list: &mut List, scale: u8, width: usize) {
        let channels = self.widths[usize::from(scale) - 1];
        for side in ["image", "lidar"] {
            for (direction, outputs, inputs) in [("conv", width, channels), ("deconv", channels, width)] {
                let module = format!("encoder.{side}_{direction}{scale}");
                list.add(format!("{module}.weight"), &[outputs, inputs, 1, 1]);
                list.add(format!("{module}.bias"), &[outputs]);
            }
        }
    }

    fn transformer(&self, list: &mut List, prefix: &str, c: usize) {
        if self.position {
            list.add(format!("{prefix}.pos_emb"), &[1, 2 * self.grid.0 * self.grid.1, c]);
        }
        list.linear(&format!("{prefix}.vel_emb"), c, 1);
        for layer in 0..self.layers {
            let module = format!("{prefix}.blocks.{layer}");
            list.norm(&format!("{module}.ln1"), c);
            list.norm(&format!("{module}.ln2"), c);
            for leaf in ["key", "query", "value", "proj"] {
                list.linear(&format!("{module}.attn.{leaf}"), c, c);
            }
            list.linear(&format!("{module}.mlp.0"), 4 * c, c);
            list.linear(&format!("{module}.mlp.2"), c, 4 * c);
        }
        list.norm(&format!("{prefix}.ln_f"), c);
    }

    fn geometric_fusion(&self, list: &mut List, side: &str, scale: usize) {
        let (c, mut input) = (self.widths[scale - 1], self.embedding);
        let pointwise = |list: &mut List, module: String, outputs: usize, inputs: usize| {
            list.add(format!("{module}.weight"), &[outputs, inputs, 1, 1]);
            list.add(format!("{module}.bias"), &[outputs]);
        };
        pointwise(list, format!("encoder.{side}_conv{scale}"), input, c);
        for (layer, &width) in self.projection.iter().enumerate() {
            list.linear(&format!("encoder.{side}_projection{scale}.{}", 2 * layer), width, input);
            input = width;
        }
        pointwise(list, format!("encoder.{side}_deconv{scale}"), c, input);
    }

    fn controller(&self, list: &mut List) {
        list.linear("controller.vel_in.0", self.hidden, 1);
        list.linear("controller.vel_in.2", self.widths[3], self.hidden);
        let mut head = |module: &str, outputs: usize| {
            list.linear(&format!("{module}.0"), self.hidden, self.widths[3]);
            list.linear(&format!("{module}.2"), self.hidden, self.hidden);
            list.linear(&format!("{module}.4"), outputs, self.hidden);
        };
        head("controller.vel_out", 1);
        (0..self.branches).for_each(|branch| head(&format!("controller.branches.{branch}"), 3));
    }

    fn head(&self, list: &mut List) {
        let mut input = self.widths[3];
        for (layer, &width) in self.join.iter().enumerate() {
            list.linear(&format!("join.{}", 2 * layer), width, input);
            input = width;
        }
        list.add("decoder.weight_ih".into(), &[3 * input, self.gru_inputs]);
        list.add("decoder.weight_hh".into(), &[3 * input, input]);
        list.add("decoder.bias_ih".into(), &[3 * input]);
        list.add("decoder.bias_hh".into(), &[3 * input]);
        list.linear("output", 2, input);
    }
}

/// Generated values with batch-norm statistics around a variance that follows from the norm's name.
pub(super) fn plausible(shapes: &[(String, Vec<usize>)], typical_variance: impl Fn(&str) -> f32) -> NamedTensors {
    let mut tensors = generate(shapes);
    for (name, shape) in shapes {
        let Some((norm, leaf)) = name.rsplit_once('.') else { continue };
        let variance = typical_variance(norm);
        let (base, amplitude) = match leaf {
            "running_var" => (variance, 0.25 * variance),
            "running_mean" => (0.0, 0.3 * variance.sqrt()),
            _ => continue,
        };
        let data = TensorData::Float(uniform(name, shape[0]).map(|u| base + amplitude * u).collect());
        tensors.insert(name, NamedTensor { shape: shape.clone(), data });
    }
    tensors
}

/// Means over the statistics that the published networks show with generated weights: the images' raw range makes the
/// first one large, the sparse LiDAR histogram small; elsewhere inputs are of order 1.
fn typical_variance(norm: &str) -> f32 {
    if norm.ends_with("features.bn1") {
        3e5
    } else if norm.ends_with("_model.bn1") {
        0.02
    } else if norm.ends_with("bn2") {
        0.7
    } else {
        2.0
    }
}

/// Names and shapes under construction.
#[derive(Default)]
pub(super) struct List(pub Vec<(String, Vec<usize>)>);

impl List {
    pub fn add(&mut self, name: String, shape: &[usize]) {
        self.0.push((name, shape.to_vec()));
    }

    fn linear(&mut self, module: &str, outputs: usize, inputs: usize) {
        self.add(format!("{module}.weight"), &[outputs, inputs]);
        self.add(format!("{module}.bias"), &[outputs]);
    }

    fn norm(&mut self, module: &str, channels: usize) {
        self.add(format!("{module}.weight"), &[channels]);
        self.add(format!("{module}.bias"), &[channels]);
    }

    /// Convolution without bias and batch norm: members `first` and `first + 1` of a module.
    pub fn conv_norm(&mut self, module: &str, first: usize, shape: [usize; 4]) {
        self.add(format!("{module}.{first}.weight"), &shape);
        self.batch_norm(&format!("{module}.{}", first + 1), shape[0]);
    }

    pub fn batch_norm(&mut self, module: &str, channels: usize) {
        self.norm(module, channels);
        self.add(format!("{module}.running_mean"), &[channels]);
        self.add(format!("{module}.running_var"), &[channels]);
        self.add(format!("{module}.num_batches_tracked"), &[]);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::golden;

    #[test]
    fn published_networks_have_the_published_names_and_shapes() {
        for system in [System::Aim, System::LateFusion, System::TransFuser, System::GeometricFusion, System::Cilrs] {
            let mut shapes = Network::published(system).shapes();
            shapes.sort();
            assert_eq!(shapes, golden::shapes(system), "{}", system.name());
        }
    }
}
