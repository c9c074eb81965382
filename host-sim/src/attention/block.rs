//! One attention block, found in an image and in a graph, and the token grids that it fuses.

use firmware::image::Image;
use firmware::program::{self, Step, TokenSource};
use model_compiler::error::{Error, ErrorCode, Result};
use model_compiler::ir::{Graph, Node, Op};
use model_compiler::record::Record;
use std::convert::Infallible;
use std::str::FromStr;

/// The remedy where the network is none that this is about.
pub(super) const FUSING_ONLY: &str = "the statistics are about fusing transformers, those of TransFuser";

/// Which block.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum BlockChoice {
    /// The last of the network.
    Last,
    /// The block of this name, or the last one of the module of this name.
    Named(String),
}

impl FromStr for BlockChoice {
    type Err = Infallible;

    fn from_str(text: &str) -> std::result::Result<Self, Infallible> {
        Ok(if text == "last" { Self::Last } else { Self::Named(text.to_owned()) })
    }
}

/// Size of a token grid.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Grid {
    /// Rows; of a LiDAR histogram the lateral cells, from right to left.
    pub rows: u16,
    /// Columns; of a LiDAR histogram the longitudinal cells, from far to near.
    pub columns: u16,
}

impl Grid {
    /// Number of tokens.
    pub fn tokens(self) -> u16 {
        self.rows * self.columns
    }
}

/// The grids of both sensors: token `columns·row + column` of the image, then, in the same order, of the LiDAR.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Grids {
    /// Of the camera image.
    pub image: Grid,
    /// Of the LiDAR histogram.
    pub lidar: Grid,
}

impl Grids {
    /// T.
    pub fn tokens(self) -> u16 {
        self.image.tokens() + self.lidar.tokens()
    }
}

/// What both forms of a block have in common.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Block {
    /// Name of the node, or of the step where the image has no record.
    pub name: String,
    /// Number of heads.
    pub heads: u16,
    /// What it fuses.
    pub grids: Grids,
}

/// A block of an image.
#[derive(Clone, Debug)]
pub struct IntegerBlock {
    /// Name, heads and grids.
    pub block: Block,
    /// Position in the program.
    pub position: usize,
    /// The step there.
    pub step: program::Attention,
    named: bool,
}

/// A block of a float graph.
#[derive(Clone, Debug)]
pub struct FloatBlock<'a> {
    /// Name, heads and grids.
    pub block: Block,
    /// The graph.
    pub graph: &'a Graph,
    /// The node of it.
    pub node: &'a Node,
}

impl IntegerBlock {
    /// Finds a block of an image; its record gives the names.
    ///
    /// # Errors
    /// There is no such block, it has no name, or it does not fuse two sensors.
    pub fn find(image: &Image<'_>, record: Option<&Record>, choice: &BlockChoice) -> Result<Self> {
        if record.is_none() && *choice != BlockChoice::Last {
            let error =
                Error::new(ErrorCode::Usage, "--block", "the blocks of an image without its record have no names");
            return Err(
                error.with_help("keep OUT.record beside OUT.img, or name it with --record; or use --block last")
            );
        }
        let program: Vec<Step> = (0..image.step_count()).filter_map(|position| image.step(position)).collect();
        let name = |position: usize| {
            let step = record.map(|record| &record.model.steps[record.plan.order[position] as usize]);
            step.map_or(format!("step {position}"), |step| step.node.as_ref().unwrap_or(&step.name).clone())
        };
        let is_attention = |position: &usize| matches!(program[*position], Step::Attention(_));
        let blocks: Vec<(usize, String)> =
            (0..program.len()).filter(is_attention).map(|position| (position, name(position))).collect();
        let (position, name) = choose(blocks, choice)?;
        let Step::Attention(step) = program[position].clone() else { unreachable!("only attention steps are chosen") };
        let shape = |id| image.tensor(id).map(|tensor| tensor.shape);
        let tokens = program[..position].iter().rev().find_map(|step| match step {
            Step::Tokens(tokens) => Some(tokens),
            _ => None,
        });
        let grid = |source: &TokenSource| {
            let map = shape(source.map)?;
            let rows = map.height.checked_div(source.pool_h.into())?;
            Some(Grid { rows, columns: map.width.checked_div(source.pool_w.into())? })
        };
        let grids = tokens.and_then(|t| Some(Grids { image: grid(&t.first)?, lidar: grid(&t.second)? }));
        let grids = fused(&name, grids, shape(step.output).map_or(0, |shape| shape.positions()))?;
        let block = Block { name, heads: step.heads, grids };
        Ok(Self { block, position, step, named: record.is_some() })
    }
}

impl<'a> FloatBlock<'a> {
    /// Finds a block of a graph.
    ///
    /// # Errors
    /// There is no such block, or it does not fuse two sensors.
    pub fn find(graph: &'a Graph, choice: &BlockChoice) -> Result<Self> {
        let is_attention = |(_, node): &(usize, &Node)| matches!(node.op, Op::Attention { .. });
        let blocks = graph.nodes.iter().enumerate().filter(is_attention);
        let (position, name) = choose(blocks.map(|(position, node)| (position, node.name.clone())).collect(), choice)?;
        let node = &graph.nodes[position];
        let Op::Attention { heads } = node.op else { unreachable!("only attention nodes are chosen") };
        let grids = graph.nodes[..position].iter().rev().find_map(|node| match &node.op {
            Op::Tokens(tokens) => {
                let grid = Grid { rows: tokens.grid.0, columns: tokens.grid.1 };
                Some(Grids { image: grid, lidar: grid })
            }
            _ => None,
        });
        let grids = fused(&name, grids, graph.value(node.output).shape.positions())?;
        Ok(Self { block: Block { name, heads, grids }, graph, node })
    }
}

/// What the blocks of an image and of a graph have in common, where there are both.
///
/// # Errors
/// They are not the same block.
pub fn common(integers: Option<&IntegerBlock>, float: Option<&FloatBlock<'_>>) -> Result<Block> {
    match (integers, float) {
        (Some(integers), Some(float)) => {
            // The name of an image without its record is none.
            let named = Block { name: float.block.name.clone(), ..integers.block.clone() };
            let found = if integers.named { &integers.block } else { &named };
            if *found != float.block {
                let describe = |b: &Block| format!("{} of {} heads over {:?}", b.name, b.heads, b.grids);
                let message = format!("its block is {}, that of the image {}", describe(&float.block), describe(found));
                let error = Error::new(ErrorCode::Tensors, "model", message);
                return Err(error.with_help("give the checkpoint that the image was compiled from"));
            }
            Ok(float.block.clone())
        }
        (Some(integers), None) => Ok(integers.block.clone()),
        (None, Some(float)) => Ok(float.block.clone()),
        (None, None) => unreachable!("one of the two is always there"),
    }
}

/// One of the blocks, which stand in the order of execution.
fn choose(mut blocks: Vec<(usize, String)>, choice: &BlockChoice) -> Result<(usize, String)> {
    if blocks.is_empty() {
        let error = Error::new(ErrorCode::Unsupported, "", "the network has no attention block");
        return Err(error.with_help(FUSING_ONLY));
    }
    let is_chosen = |name: &str| match choice {
        BlockChoice::Last => true,
        BlockChoice::Named(chosen) => {
            name.strip_prefix(chosen.as_str()).is_some_and(|r| r.is_empty() || r.starts_with('.'))
        }
    };
    match blocks.iter().rposition(|(_, name)| is_chosen(name)) {
        Some(index) => Ok(blocks.swap_remove(index)),
        None => {
            let BlockChoice::Named(name) = choice else { unreachable!("the last of some blocks is there") };
            let names: Vec<&str> = blocks.iter().map(|(_, name)| name.as_str()).collect();
            let error = Error::new(ErrorCode::Usage, "--block", format!("no attention block is called {name}"));
            Err(error.with_help(format!("last, or one of {}, or a module of these", names.join(", "))))
        }
    }
}

/// The grids, if they make up the tokens of the block.
fn fused(name: &str, grids: Option<Grids>, tokens: u32) -> Result<Grids> {
    grids.filter(|grids| u32::from(grids.tokens()) == tokens).ok_or_else(|| {
        let message = "it does not attend over the tokens of a camera image and of a LiDAR histogram";
        let error = Error::new(ErrorCode::Unsupported, format!("attention block {name}"), message);
        error.with_help(FUSING_ONLY)
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn blocks() -> Vec<(usize, String)> {
        let name = |(scale, layer): (u8, u8)| format!("encoder.transformer{scale}.blocks.{layer}.attn.context");
        [(1, 0), (1, 1), (2, 0), (2, 1), (2, 10)].map(name).into_iter().enumerate().collect()
    }

    fn chosen(text: &str) -> Result<usize> {
        choose(blocks(), &text.parse().unwrap()).map(|(position, _)| position)
    }

    #[test]
    fn a_block_is_the_last_or_has_a_name_or_is_the_last_of_a_module() {
        assert_eq!(chosen("last").unwrap(), 4);
        assert_eq!(chosen("encoder.transformer1.blocks.0.attn.context").unwrap(), 0);
        assert_eq!(chosen("encoder.transformer2.blocks.1").unwrap(), 3, "and not blocks.10");
        assert_eq!(chosen("encoder.transformer1").unwrap(), 1);
    }

    #[test]
    fn an_unknown_block_is_refused_with_the_known_ones() {
        let error = chosen("encoder.transformer").unwrap_err().to_string();
        assert!(error.contains("no attention block is called encoder.transformer"), "{error}");
        assert!(error.contains("encoder.transformer2.blocks.10.attn.context"), "{error}");
        let error = choose(Vec::new(), &BlockChoice::Last).unwrap_err();
        assert_eq!((error.code, error.help.as_str()), (ErrorCode::Unsupported, FUSING_ONLY));
    }

    #[test]
    fn tokens_that_are_not_two_grids_are_refused() {
        let grid = Grid { rows: 2, columns: 3 };
        let grids = Grids { image: grid, lidar: grid };
        assert_eq!(fused("a", Some(grids), 12).unwrap(), grids);
        assert!(fused("a", Some(grids), 6).is_err() && fused("a", None, 12).is_err());
    }
}
