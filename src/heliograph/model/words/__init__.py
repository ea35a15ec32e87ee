"""Words of finite length: their encoder, and channels of them."""
