"""A run of the toy pipeline in a process of its own: fault_driver.py JSON; prints {image: error} and, apart, a StoreError."""

import json
import sys

import toy_pipeline

from sftex_stages.errors import SftexError

if __name__ == "__main__":
    job = json.loads(sys.argv[1])
    try:
        found, _ = toy_pipeline.run(job["out"], *job["files"], workers=2, **job["params"])
    except SftexError as error:
        print(json.dumps({"": str(error)}))
        sys.exit(2)
    print(json.dumps({name: result.error for name, result in found.items()}))
