//! Options of the `attention` command.

use crate::attention::block::BlockChoice;
use crate::attention::queries::QueryRows;
use clap::Args;

/// Which rows of which block are counted.
#[derive(Debug, Args)]
pub struct AttentionArgs {
    /// Attention block: a name, or a module of which the last block is taken (encoder.transformer2), or last.
    #[arg(long, value_name = "NAME", default_value = "last")]
    pub block: BlockChoice,
    /// Rows of the image tokens whose queries count, from above, the first is 0 [default: as in the paper, 2,3,4 of 8
    /// rows, and as much of other grids].
    #[arg(long, value_name = "ROW,…", value_delimiter = ',')]
    image_rows: Option<Vec<u16>>,
    /// The same of the LiDAR tokens, from far to near [default: as in the paper, 4,5,6 of 8 rows].
    #[arg(long, value_name = "ROW,…", value_delimiter = ',')]
    lidar_rows: Option<Vec<u16>>,
    /// Strongest keys of each query and head [default: 5, or as many as a sensor has tokens].
    #[arg(long, value_name = "N")]
    pub top: Option<u16>,
}

impl AttentionArgs {
    /// The rows that were chosen.
    pub fn rows(&self) -> QueryRows {
        QueryRows { image: self.image_rows.clone(), lidar: self.lidar_rows.clone() }
    }
}
