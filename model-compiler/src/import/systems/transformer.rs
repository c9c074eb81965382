//! The transformer that fuses an image map and a LiDAR map at one scale.
//!
//! As published every scale has a transformer of its own, as wide as its maps. In the ablation of a shared one the same
//! modules serve all scales, behind 1×1 convolutions to their width and in front of those back to the maps'.

use super::builder::Builder;
use super::detect::{common_length, indexed_count, most_common};
use super::has;
use crate::error::Result;
use crate::import::NamedTensors;
use crate::ir::{Clip, LayerNorm, Linear, Op, Tokens, ValueId, Weights};
use std::sync::Arc;

/// As published.
const DEFAULT_HEADS: u16 = 4;

/// Module of the transformer that all scales share.
const SHARED: &str = "encoder.transformer";

fn prefix(scale: usize) -> String {
    format!("{SHARED}{scale}")
}

/// Module of a 1×1 convolution in front of (`conv`) or behind (`deconv`) a shared transformer.
fn projection(side: &str, direction: &str, scale: usize) -> String {
    format!("encoder.{side}_{direction}{scale}")
}

/// Whether the scales share one transformer.
pub(super) fn is_shared(tensors: &NamedTensors) -> bool {
    has(tensors, &format!("{SHARED}."))
}

/// Positional embeddings that are there.
fn positions(tensors: &NamedTensors) -> impl Iterator<Item = &[usize]> {
    let modules = (1..=4).map(prefix).chain([SHARED.to_owned()]);
    modules.filter_map(|module| Some(&tensors.get(&format!("{module}.pos_emb"))?.shape[..]))
}

/// Tokens that the positional embeddings are made for, both maps together.
pub(super) fn tokens(tensors: &NamedTensors) -> Option<usize> {
    most_common(positions(tensors).filter_map(|shape| shape.get(1).copied()))
}

/// Which scales are fused, and by what.
pub(super) struct Fusions {
    /// Channels of the maps per scale.
    widths: [usize; 4],
    grid: (u16, u16),
    /// Per scale.
    is_fused: [bool; 4],
    /// Positional embeddings belong to all transformers or to none (the ablation without them; where it kept its unused
    /// zeros in the checkpoint, adding them changes nothing).
    has_position: bool,
    /// The transformer of all scales, with its width.
    shared: Option<(Transformer, usize)>,
}

impl Fusions {
    /// A scale without tensors of its own is not fused. The tensors of a shared transformer are taken here.
    pub(super) fn detect(b: &mut Builder<'_>, widths: [usize; 4], grid: (u16, u16)) -> Self {
        let is_shared = is_shared(&b.tensors);
        let modules = |scale: usize| match is_shared {
            true => projections(scale).into_iter().flatten().collect(),
            false => vec![prefix(scale)],
        };
        let is_fused =
            std::array::from_fn(|s| modules(s + 1).iter().any(|module| has(&b.tensors, &format!("{module}."))));
        let has_position = positions(&b.tensors).next().is_some();
        let shared = is_shared.then(|| {
            let attention = |name: &str| name.contains(".attn.");
            let width = common_length(&b.tensors, &[&format!("{SHARED}.blocks.")], attention).unwrap_or(widths[3]);
            (Transformer::take(b, SHARED, width, grid, has_position), width)
        });
        Self { widths, grid, is_fused, has_position, shared }
    }

    /// Whether any scale is fused.
    pub(super) fn any(&self) -> bool {
        self.is_fused.contains(&true)
    }

    /// The fusion of scale 1..=4, with the tensors that are its own.
    pub(super) fn take(&self, b: &mut Builder<'_>, scale: usize) -> Option<Fusion> {
        let channels = self.widths[scale - 1];
        if !self.is_fused[scale - 1] {
            return None;
        }
        let Some((transformer, width)) = &self.shared else {
            let transformer = Transformer::take(b, &prefix(scale), channels, self.grid, self.has_position);
            return Some(Fusion { scale, transformer, projections: None });
        };
        let projections = projections(scale).map(|[conv, deconv]| Projections {
            to: b.pointwise(&conv, channels, *width),
            back: b.pointwise(&deconv, *width, channels),
        });
        Some(Fusion { scale, transformer: transformer.clone(), projections: Some(projections) })
    }
}

/// Modules of the 1×1 convolutions in front of and behind a shared transformer, of both maps.
fn projections(scale: usize) -> [[String; 2]; 2] {
    SIDES.map(|side| ["conv", "deconv"].map(|direction| projection(side, direction, scale)))
}

/// The two maps, in the order of their tokens.
const SIDES: [&str; 2] = ["image", "lidar"];

/// The modules of a transformer.
#[derive(Clone)]
struct Transformer {
    grid: (u16, u16),
    embedding: Tokens,
    blocks: Vec<Block>,
    norm: LayerNorm,
}

/// One layer.
#[derive(Clone)]
struct Block {
    norms: [LayerNorm; 2],
    query: Linear,
    key: Linear,
    value: Linear,
    projection: Linear,
    mlp: [Linear; 2],
}

impl Transformer {
    /// Takes the tensors of a module.
    fn take(b: &mut Builder<'_>, module: &str, channels: usize, grid: (u16, u16), has_position: bool) -> Self {
        let name = |leaf: &str| format!("{module}.{leaf}");
        let blocks = name("blocks.");
        let hidden = common_length(&b.tensors, &[&blocks], |n| n.contains(".mlp.0.")).unwrap_or(4 * channels);
        let layers = indexed_count(&b.tensors, &blocks).max(1);
        let count = 2 * usize::from(grid.0) * usize::from(grid.1);
        let position = has_position.then(|| {
            let weights = b.weights(&name("pos_emb"), &[1, count, channels]);
            let data = Arc::unwrap_or_clone(weights).data;
            Arc::new(Weights { shape: vec![count, channels], data })
        });
        let embedding = Tokens {
            grid,
            position,
            velocity_weights: b.vector(&name("vel_emb.weight"), &[channels, 1]),
            velocity_bias: b.vector(&name("vel_emb.bias"), &[channels]),
        };
        let blocks = (0..layers).map(|layer| Block::take(b, &format!("{blocks}{layer}"), channels, hidden, count));
        let blocks = blocks.collect();
        Self { grid, embedding, blocks, norm: b.layer_norm(&name("ln_f"), channels, grid) }
    }
}

impl Block {
    fn take(b: &mut Builder<'_>, module: &str, channels: usize, hidden: usize, tokens: usize) -> Self {
        let name = |leaf: &str| format!("{module}.{leaf}");
        let norms = ["ln1", "ln2"].map(|leaf| b.layer_norm(&name(leaf), channels, (tokens as u16, 1)));
        let mut square = |leaf: &str| b.linear_weights(&name(leaf), channels, channels);
        let (query, key) = (square("attn.query"), square("attn.key"));
        let (value, projection) = (square("attn.value"), square("attn.proj"));
        let mlp =
            [b.linear_weights(&name("mlp.0"), channels, hidden), b.linear_weights(&name("mlp.2"), hidden, channels)];
        Self { norms, query, key, value, projection, mlp }
    }

    /// Values are named like the modules of a scale's own transformer.
    fn push(&self, b: &mut Builder<'_>, module: &str, stream: ValueId) -> Result<ValueId> {
        let name = |leaf: &str| format!("{module}.{leaf}");
        let linear =
            |b: &mut Builder<'_>, leaf: &str, linear: &Linear, x| b.push(name(leaf), Op::Linear(linear.clone()), &[x]);
        let [first, second] = &self.norms;
        let x = b.push(name("ln1"), Op::LayerNorm(first.clone()), &[stream])?;
        let query = linear(b, "attn.query", &self.query, x)?;
        let key = linear(b, "attn.key", &self.key, x)?;
        let value = linear(b, "attn.value", &self.value, x)?;
        let attention = Op::Attention { heads: b.options.heads.unwrap_or(DEFAULT_HEADS) };
        let context = b.push(name("attn.context"), attention, &[query, key, value]);
        let context = context.map_err(|e| e.with_help("--heads sets the number of heads"))?;
        let branch = linear(b, "attn.proj", &self.projection, context)?;
        let stream = b.push(name("attn.add"), Op::Add { clip: Clip::NONE }, &[branch, stream])?;

        let x = b.push(name("ln2"), Op::LayerNorm(second.clone()), &[stream])?;
        let x = linear(b, "mlp.0", &self.mlp[0], x)?;
        let x = b.push(name("mlp.1"), Op::Clip(Clip::RELU), &[x])?;
        let branch = linear(b, "mlp.2", &self.mlp[1], x)?;
        b.push(module, Op::Add { clip: Clip::NONE }, &[branch, stream])
    }
}

/// The 1×1 convolutions of one map at one scale: to the width of a shared transformer, and back.
struct Projections {
    to: Linear,
    back: Linear,
}

/// What fuses the maps of one scale.
pub(super) struct Fusion {
    scale: usize,
    transformer: Transformer,
    /// Of image and LiDAR map, around a shared transformer.
    projections: Option<[Projections; 2]>,
}

impl Fusion {
    /// Adds the fused features to both maps.
    pub(super) fn fuse(
        &self,
        b: &mut Builder<'_>,
        image: ValueId,
        lidar: ValueId,
        velocity: ValueId,
    ) -> Result<(ValueId, ValueId)> {
        let p = prefix(self.scale);
        let Transformer { grid, embedding, blocks, norm } = &self.transformer;
        let (image_tokens, lidar_tokens) = (self.project(b, 0, image)?, self.project(b, 1, lidar)?);
        let tokens = Op::Tokens(embedding.clone());
        let mut stream = b.push(format!("{p}.tokens"), tokens, &[image_tokens, lidar_tokens, velocity])?;
        for (layer, block) in blocks.iter().enumerate() {
            stream = block.push(b, &format!("{p}.blocks.{layer}"), stream)?;
        }
        let lidar_norm = LayerNorm { first_row: grid.0 * grid.1, ..norm.clone() };
        let image = self.add_back(b, 0, norm.clone(), stream, image)?;
        let lidar = self.add_back(b, 1, lidar_norm, stream, lidar)?;
        Ok((image, lidar))
    }

    /// A map in the width of a shared transformer, pooled to the token grid; without projections the map itself.
    fn project(&self, b: &mut Builder<'_>, side: usize, map: ValueId) -> Result<ValueId> {
        let Some(projections) = &self.projections else { return Ok(map) };
        let (name, conv) = (SIDES[side], projections[side].to.clone());
        let features = b.push(projection(name, "conv", self.scale), Op::Linear(conv), &[map])?;
        b.pooled_to(format!("encoder.{name}_embedding{}", self.scale), features, self.transformer.grid)
    }

    /// Final LayerNorm of one map's tokens, enlarged to the map's size and added to it.
    fn add_back(
        &self,
        b: &mut Builder<'_>,
        side: usize,
        norm: LayerNorm,
        stream: ValueId,
        map: ValueId,
    ) -> Result<ValueId> {
        let (p, name) = (prefix(self.scale), SIDES[side]);
        let mut branch = b.push(format!("{p}.ln_f.{name}"), Op::LayerNorm(norm), &[stream])?;
        let size = b.graph.value(map).shape;
        branch = b.enlarged_to(format!("{p}.upsample.{name}"), branch, (size.height, size.width))?;
        if let Some(projections) = &self.projections {
            let conv = Op::Linear(projections[side].back.clone());
            branch = b.push(projection(name, "deconv", self.scale), conv, &[branch])?;
        }
        b.push(format!("{p}.add.{name}"), Op::Add { clip: Clip::NONE }, &[branch, map])
    }
}
