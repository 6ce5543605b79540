//! The U-Net of Open Image Denoise (`demc_model::unet`) as a graph.

use demc_data::Normalizer;
use demc_model::config::COLOR_CHANNELS;
use demc_model::layers::ConvStack;
use demc_model::side_encoder::SideEncoder;
use demc_model::unet::Unet;

use super::graph::{AttributeValue, GraphBuilder, Value};

impl GraphBuilder {
    pub(super) fn unet(&mut self, network: &Unet, normalizer: &Normalizer) {
        let color = self.compressed(normalizer, None);
        let mut inputs = vec![color.clone()];
        let guides = network.guides().first_channels();
        let takes_features = !guides.is_empty() || network.side.is_some();
        let features = takes_features.then(|| {
            let clamped = self.clamped_features(normalizer);
            self.features_z(normalizer, &clamped)
        });
        for first in guides {
            let channels = *first..first + COLOR_CHANNELS;
            let features = features.as_ref().expect("guides are features");
            inputs.push(self.channels(&format!("guide.{first}"), features, channels));
        }
        let side = network.side.as_ref().zip(features);
        let mut side = side.map(|(side, features)| (side, self.side_maps(side, features)));
        let inputs: Vec<&Value> = inputs.iter().collect();
        let mut x = self.concat("inputs", &inputs);
        let mut skips = Vec::new();
        for level in &network.encoder {
            skips.push(x.clone());
            let y = self.unet_level(&x, level);
            x = self.pooled(&y);
        }
        x = self.unet_level(&x, &network.bottom);
        for (index, level) in network.decoder.iter().enumerate() {
            let skip = skips.pop().expect("a skip for each level");
            let both = self.doubled_with(&x, &skip);
            x = self.unet_level(&both, level);
            if let Some((side, maps)) = &mut side {
                let map = maps.pop().expect("a map for each level");
                let both = self.concat(&format!("{}.fused", x.0), &[&x, &map]);
                let fused = self.conv(&both, &side.fuses[index], None);
                x = self.relu(&fused);
            }
        }
        let y = self.conv(&x, &network.head, None);
        let out = self.relu(&y);
        self.expanded(normalizer, &out);
    }

    /// The map of each level, from the full resolution down (`demc_model::side_encoder`).
    fn side_maps(&mut self, side: &SideEncoder, features: Value) -> Vec<Value> {
        let mut x = match &side.fusion {
            Some(fusion) => self.detail_map(&features, fusion),
            None => features,
        };
        let mut maps: Vec<Value> = Vec::new();
        for level in &side.levels {
            if !maps.is_empty() {
                x = self.pooled(&x);
            }
            x = self.unet_level(&x, level);
            maps.push(x.clone());
        }
        maps
    }

    fn unet_level(&mut self, x: &Value, level: &ConvStack) -> Value {
        level.convs.iter().fold(x.clone(), |x, conv| {
            let y = self.conv(&x, conv, None);
            self.relu(&y)
        })
    }

    /// The map, doubled by repeating pixels, and the channels of `skip`.
    fn doubled_with(&mut self, x: &Value, skip: &Value) -> Value {
        let name = |what: &str| format!("{}.{what}", x.0);
        let scales = self.constant(&name("scales"), &[4], &[1.0, 1.0, 2.0, 2.0]);
        let nearest = [
            ("mode", AttributeValue::Text("nearest")),
            (
                "coordinate_transformation_mode",
                AttributeValue::Text("asymmetric"),
            ),
            ("nearest_mode", AttributeValue::Text("floor")),
        ];
        let region = Value(String::new());
        let doubled = self.node("Resize", &name("doubled"), &[x, &region, &scales], &nearest);
        self.concat(&name("appended"), &[&doubled, skip])
    }
}
