# Make a bucket, and a key that may do with it what s3-policy.json says; called again, it changes nothing.
#
# Runs in the image of RustFS, which has curl. The bucket is made by the protocol of S3, key and policy by RustFS's own
# interface, which other servers do not have. No secret is an argument of a command, since those are listed by `ps`.
set -eu
umask 077
body=$(mktemp)

# request METHOD PATH [CURL OPTIONS]: send what is in $body, signed by the root key; the answer must be a success.
request() {
    method=$1 path=$2
    shift 2
    hash=$(sha256sum "$body" | cut -d ' ' -f 1)
    printf 'user = "%s:%s"\n' "$RUSTFS_ACCESS_KEY" "$RUSTFS_SECRET_KEY" |
        curl --config - --aws-sigv4 aws:amz:us-east-1:s3 \
            --header "x-amz-content-sha256: $hash" --header "content-type: application/json" \
            --fail-with-body --silent --show-error "$@" --request "$method" "$S3_ENDPOINT$path"
}

request HEAD "/$S3_BUCKET" --head >/dev/null 2>&1 || request PUT "/$S3_BUCKET"
cat "$(dirname "$0")/s3-policy.json" >"$body"
request PUT "/rustfs/admin/v3/add-canned-policy?name=adaafford" --data-binary "@$body"
printf '{"secretKey": "%s", "status": "enabled"}' "$S3_SECRET" >"$body"
request PUT "/rustfs/admin/v3/add-user?accessKey=$S3_KEY" --data-binary "@$body"
: >"$body"
request PUT "/rustfs/admin/v3/set-user-or-group-policy?isGroup=false&policyName=adaafford&userOrGroup=$S3_KEY"
rm "$body"
echo "bucket $S3_BUCKET and key $S3_KEY are ready"
